"""A clock that the data show to be off is taken off while the node runs, as a replay does before it begins."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from ..calibration.parameters import Parameters
from ..calibration.register.registration import ALIKE_S, OFFSETS, Registration
from ..verdict.reasons import Reason, finding


class LateClocks:
    """What is to be taken off, once: where nobody named an offset, and two looks at the clocks agree.

    found: what is said of it, while it is off. stand: whether nothing more is to be taken off.
    """

    def __init__(self, given: Collection[str]) -> None:
        """given: names of the parameters that the user named."""
        self.stand = bool(OFFSETS.keys() & set(given))
        self._before: Registration | None = None
        self.found: list[Reason] = []

    def parameters(self, registration: Registration | None, parameters: Parameters) -> Parameters | None:
        """The parameters to begin anew with, by the newest look; None for as they are."""
        if self.stand or registration is None or registration is self._before:
            return None
        before, self._before = self._before, registration
        late = registration.taken_off
        if before is None or not late or not _are_alike(before.taken_off, late):
            return None
        self.stand = True
        taken = {name: round(getattr(parameters, name) + seconds, 3) for name, seconds in late.items()}
        self.found = [
            finding("CLOCK_TAKEN_OFF", clock=registration.told(name), parameter=name, value=seconds)
            for name, seconds in taken.items()
        ]
        return parameters.replace(**taken)


def _are_alike(one: Mapping[str, float], other: Mapping[str, float]) -> bool:
    return one.keys() == other.keys() and all(abs(one[name] - other[name]) < ALIKE_S for name in other)
