"""Why a model's estimate is the one: as a replay and /diagnostics say it of the selected model."""

from __future__ import annotations

from functools import partial

from .kinds import Kind, Severity

_Said = partial(Kind, page="troubleshooting.md#why-a-model-is-selected", severity=Severity.ACCEPT)
SELECTIONS = (
    _Said("MODEL_NAMED", "set by parameter model", "The parameter names one model.", ""),
    _Said("MODEL_CHOSEN", "{by}: {gnss}", "The parameter model is auto or iac, which go by GNSS.", ""),
    _Said("MODEL_CHOSEN_AS", "{by}: {gnss}; {why}", "As MODEL_CHOSEN, and by what the data show beside.", ""),
    _Said("GNSS_AVAILABLE", "GNSS is available", "References keep coming (gnss_timeout).", ""),
    _Said("GNSS_NOT_AVAILABLE", "GNSS is not available", "No reference has come for gnss_timeout.", ""),
    _Said(
        "GNSS_GOING",
        "GNSS has stopped; the model changes if it stays away for gnss_hysteresis",
        "No reference comes, but the outage is still short.",
        "",
    ),
    _Said(
        "GNSS_COMING",
        "GNSS is back; the model changes if it stays for gnss_hysteresis",
        "References come again, but not for long yet.",
        "",
    ),
    _Said(
        "HEADINGS_TELL_CURRENT",
        "headings tell a current from the mounting",
        "The mounting turns with the vehicle, a current does not.",
        "",
    ),
    _Said(
        "HEADINGS_TOO_FEW",
        "no attitude over headings that would tell a current from the mounting",
        "On one heading, or without an IMU, a current looks like a mounting.",
        "",
    ),
    _Said("TRIM_KNOWN", "the trim is known", "The IMU gives roll and pitch, which a model with attitude uses.", ""),
    _Said(
        "ARM_TAKEN_AS_KNOWN",
        "{model} takes the lever arm as known, and {turns}",
        "The model that finds the lever arm has it in σ.",
        "",
    ),
    _Said(
        "ARM_OR_DELAY_SHOWN",
        "{model} does not explain the data, which show {shown}",
        "The model that finds lever arm and delay explains them.",
        "",
    ),
    _Said(
        "ARM_LOOKS_LIKE_ANGLE",
        "on this track a {metres:g} m error of the lever arm looks like {degrees:.1f}° of {angle}",
        "Turns to one side at one speed do not tell a lever arm from an angle.",
        "",
    ),
    _Said(
        "POSITIONS_NOISY",
        "velocities made of the positions would be off by {noise:.1f} m/s, so these are compared over legs",
        "Positions with metres of noise: USBL, plain GPS.",
        "",
    ),
    _Said(
        "POSITIONS_SELDOM",
        "positions come too seldom to make velocities of them, so these are compared over legs",
        "More than three times position_window between two.",
        "",
    ),
    _Said("ARM_SHOWN", "a lever arm of {axes} m", "Another than the one that was given.", ""),
    _Said("DELAY_SHOWN", "DVL stamps {seconds:.2f} s {way}", "Against the clocks of reference and IMU.", ""),
    _Said("ARM_OR_DELAY_NOT_TOLD", "a lever arm or a delay", "Neither shows by itself.", ""),
    _Said("NO_EVIDENCE", "{model} explains the data as well", "Nothing speaks for another lever arm or a delay.", ""),
)
