"""What a diagnosis concludes: whether there is a gap, what explains it, and what is left."""

from __future__ import annotations

from dataclasses import replace

from .kinds import Kind, Severity

_FALLS = "the error falls from {before:.1f} to {after:.1f} mm/s on held-out data, where the noise is {noise:.1f} mm/s"
_KINDS = (
    Kind(
        "GAP_EXPLAINED",
        "the gap is explained by {names}: " + _FALLS,
        "The verdict known.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "GAP_AMBIGUOUS",
        "the gap is explained by {names}: " + _FALLS + "; this data cannot tell which it is",
        "The verdict ambiguous: several effects explain the data as well.",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "GAP_PARTLY_UNKNOWN",
        "{names} explain only part of the gap, and no effect of the library explains the rest: " + _FALLS,
        "The verdict unknown, with effects that were found.",
        "",
        Severity.REJECT,
    ),
    Kind(
        "GAP_UNKNOWN",
        "no effect of the library explains the error of {before:.1f} mm/s, where the noise is {noise:.1f} mm/s",
        "The verdict unknown.",
        "",
        Severity.REJECT,
    ),
    Kind(
        "NO_GAP",
        "no gap beyond the noise of {noise:.1f} mm/s; {visible} of {tested} effects would have been found at sizes "
        "that matter",
        "The verdict no_gap.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "GAP_NOT_TESTABLE",
        "this recording cannot rule out a gap: only {visible} of {tested} effects would have been found in it",
        "The verdict insufficient_excitation: too little motion shows too few effects.",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "GAP_TOO_SHORT",
        "this recording cannot show a gap: {samples} samples over {seconds:.0f} s are too few",
        "Samples are those that have DVL, reference and attitude together.",
        "record {wanted:.0f} s at least, better 600 s",
        Severity.MARGINAL,
    ),
    Kind(
        "GAP_REFERENCE_CONSTANT",
        "this recording cannot show a gap: the reference velocity is constant to the last digit",
        "A receiver that has stopped says nothing.",
        "check the receiver",
        Severity.MARGINAL,
    ),
    Kind(
        "GAP_REFERENCE_VERTICAL",
        "this recording cannot show a gap: the reference does not measure the horizontal velocity",
        "Only x and y of the body tell most effects.",
        "record a horizontal reference velocity",
        Severity.MARGINAL,
    ),
    Kind(
        "REST_UNEXPLAINED",
        "{rest:.1f} mm/s are not explained",
        "What is left on held-out data beyond the noise.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "REST_FOLLOWS",
        "what is left follows {about}",
        "What is left changes with it more than chance would.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "REST_FOLLOWS_PERIOD",
        "what is left follows a period of {seconds:.0f} s",
        "What is left changes with it more than chance would.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "REST_FOLLOWS_NOTHING",
        "nothing shows what the rest depends on",
        "What is left changes with neither motion nor time more than chance would.",
        "",
        Severity.ACCEPT,
    ),
    # what to record next
    Kind(
        "NEXT_TELL_APART",
        "to tell {name} from {others}: {manoeuvre}",
        "Several effects explain the gap as well.",
        "",
        Severity.ACCEPT,
    ),
    Kind("NEXT_SHOW", "to see {name}: {manoeuvre}", "What this recording shows worst.", "", Severity.ACCEPT),
    Kind(
        "NEXT_SAME_ROUTE",
        "the same route again: what stays with the place, the time or the motion tells what it follows",
        "No effect of the library explains the gap.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "NEXT_RECORD",
        "record {needs} as well, to test {names}",
        "All effects that this recording can test would show.",
        "",
        Severity.ACCEPT,
    ),
    Kind("NEXT_NOTHING", "nothing: all effects show", "No other motion would tell more.", "", Severity.ACCEPT),
    Kind(
        "NEXT_ANYTHING",
        "straight legs on several headings and at several speeds, with turns to both sides",
        "Nothing could be tested.",
        "",
        Severity.ACCEPT,
    ),
)
DIAGNOSES = tuple(replace(kind, page="troubleshooting.md#what-a-diagnosis-says") for kind in _KINDS)
