"""What to drive next so that a calibration becomes good enough, and that it is."""

from __future__ import annotations

from functools import partial

from .kinds import Kind, Severity

_Said = partial(Kind, page="troubleshooting.md#what-to-drive-next", severity=Severity.ACCEPT, remedy="")
MANOEUVRES = (
    _Said("NEXT_LEG", "drive straight, {name} ({compass:.0f}°)", "Another heading tells a current from the mounting."),
    _Said("NEXT_AHEAD", "drive straight ahead", "Motion ahead shows yaw, pitch and scale."),
    _Said("NEXT_FASTER", "drive straight, at {speed:.1f} m/s", "An angle shows in proportion to the speed."),
    _Said("NEXT_SPEEDS", "speed up and slow down by half", "A delay shows in accelerations, a bias at two speeds."),
    _Said("NEXT_CIRCLE", "circle to {side}", "Turns show the lever arm, and average what stays with the earth."),
    _Said("NEXT_EIGHT", "drive a figure eight", "Turns to both sides tell a lever arm from a yaw."),
    _Said("NEXT_DIVE", "dive and rise by 10° of pitch", "Pitching shows what the vertical axis brings."),
    _Said("NEXT_WAIT", "keep on: nothing is learnt yet", "The models have not used a sample, or the vehicle stands."),
    _Said(
        "NEXT_REJECTED",
        "nothing: the findings say why this calibration is not to be used",
        "A replay would reject it: more data of the same kind do not help.",
    ),
    _Said(
        "NEXT_STANDS",
        "keep on: the goal is reached, if it stays so",
        "What is predicted differs from second to second, so that it has to stand for half a minute.",
    ),
    _Said("NEXT_IS_GOOD", "good enough: save", "The predicted drift is within target_drift."),
    _Said(
        "NEXT_IS_GOOD_BUT_SCALE",
        "as good as it gets without a reference: save; the scale stays unknown",
        "The drift by yaw is within target_drift. Only a reference velocity shows a scale.",
    ),
    _Said(
        "WORTH_OF_ANOTHER_MODEL",
        "no longer good enough: the model is {model} now",
        "Model auto follows the reference. In an outage a model without a reference is in use, and would be saved.",
        remedy="Wait for the reference, or name the model.",
    ),
    _Said(
        "WORTH_HAS_FALLEN",
        "no longer good enough: the predicted drift has grown to {worth:.1f} m per km",
        "Newer data differ from the older by more than the σ had claimed.",
        remedy="Drive on. If it happens again, look for the cause with `dvl-calib doctor`.",
    ),
)
