"""What a comparison of a simulator's DVL with the vehicle's concludes, of recordings that are not of one motion."""

from __future__ import annotations

from functools import partial

from .kinds import Kind, Severity

_Said = partial(Kind, page="troubleshooting.md#what-a-comparison-with-a-simulator-says", remedy="")
UNPAIRED = (
    _Said(
        "SIMULATOR_LACKS",
        "the simulator lacks {names}",
        "The vehicle's recordings show these effects, and the simulator's do not.",
        severity=Severity.REJECT,
    ),
    _Said(
        "SIMULATOR_OTHER_SIZE",
        "the simulator has {names} of another size",
        "Both show these effects, and their 95 % intervals differ by more than chance.",
        severity=Severity.REJECT,
    ),
    _Said(
        "SIMULATOR_ALONE_HAS",
        "the simulator has {names} which the vehicle has not",
        "The simulator's recordings show these effects, and the vehicle's do not.",
        severity=Severity.REJECT,
    ),
    _Said(
        "SIMULATOR_PUT_RIGHT",
        "put right, its error on the vehicle's own motion falls from {before:.1f} to {after:.1f} mm/s, held out",
        "Each side's DVL is simulated on the stretches of the vehicle's motion that were held out.",
        severity=Severity.ACCEPT,
    ),
    _Said(
        "SIMULATOR_ROUNDS",
        "after round {round} the simulator's error on the vehicle's own motion is {after:.1f} mm/s instead of "
        "{before:.1f}, held out; noise alone makes {floor:.1f}",
        "In each round the simulator's DVL was put right, simulated on the simulator's motion and compared again.",
        severity=Severity.ACCEPT,
    ),
    _Said(
        "SIMULATOR_ROUNDS_IN_VAIN",
        "put right, the simulator comes no closer: its error on the vehicle's own motion stays {before:.1f} mm/s, "
        "held out; noise alone makes {floor:.1f}",
        "No round differs in less, or has a smaller error, than the simulator as it was recorded.",
        severity=Severity.MARGINAL,
    ),
    _Said(
        "SIMULATOR_NO_ROUNDS",
        "nothing differs that could be put right, so no round was made",
        "The loop ends where the comparison claims no difference.",
        severity=Severity.ACCEPT,
    ),
    _Said(
        "SIMULATOR_NOT_SHOWN",
        "these recordings show no difference in effects, and could not have shown some that matter",
        "One side's motion shows too few effects.",
        severity=Severity.MARGINAL,
    ),
    _Said(
        "SIMULATOR_ALIKE",
        "the simulator lacks no effect that these recordings show",
        "What both can show is of one size.",
        severity=Severity.ACCEPT,
    ),
    _Said(
        "SIMULATOR_NOISE",
        "the noise differs in {names}",
        "Noise, rate, gaps or outliers of the streams.",
        severity=Severity.MARGINAL,
    ),
    _Said(
        "SIMULATOR_UNKNOWN_REST",
        "something in the log of the {sides} follows no effect of the library",
        "The diagnosis of that side alone says unknown.",
        severity=Severity.MARGINAL,
    ),
    _Said(
        "SIMULATOR_NOTHING_COMPARED",
        "nothing can be compared: of the {side}, {why}",
        "That side's recordings cannot be diagnosed.",
        severity=Severity.MARGINAL,
    ),
)
