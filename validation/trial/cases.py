"""Draw a case: its scene, its faults and its truth.

A case is drawn from its own random stream, keyed by the trial's seed and the case's key: any case in any order, on any
machine, is the same.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from dvl_calib_ros.errors import InputError

from . import half_real, simulated
from .plan import Case, Family
from .strength import Scene, Yardstick
from .truth import Truth
from .vehicle import Faults

MAX_DRAWS = 100


@dataclass(frozen=True)
class Drawn:
    """A case as it is recorded: its scene, its faults, its truth, and the random stream of the noise."""

    scene: Scene
    faults: Faults
    truth: Truth
    noise: np.random.Generator


class NotDrawnError(InputError):
    """No draw of a case is what it is meant to be: a seed lacks this case."""


def draw(case: Case, seed: int) -> Drawn:
    """Draw until the case is what it is meant to be. Raises NotDrawnError if it never is."""
    rng, noise = case.seeds(seed)
    source = simulated if case.family is Family.SIMULATED else half_real
    for _ in range(MAX_DRAWS):
        scene = source.scene(case, rng)
        known = source.faults(case, scene, rng)
        if known is not None:
            faults, rest = known
            scene = half_real.as_recorded(case, scene)
            return Drawn(scene, faults, _truth(case, scene, faults, rest), noise)
    raise NotDrawnError(f"{case.key}: none of {MAX_DRAWS} draws is as it should be; use another --seed")


def _truth(case: Case, scene: Scene, faults: Faults, rest: dict[str, Any]) -> Truth:
    yardstick = Yardstick(scene)
    return Truth(
        id=case.id,
        category=case.category,
        kind=case.kind,
        key=case.key,
        family=case.family.value,
        faults=faults,
        q_wanted=case.q,
        hardness=case.hardness,
        twin=case.twin.id if case.twin != case else None,
        before_mps=yardstick.error_mps(faults, {}),
        noise_mps=yardstick.noise_mps,
        scene=_document(scene),
        **rest,
    )


def _document(scene: Scene) -> dict[str, Any]:
    rest = {f.name: getattr(scene, f.name) for f in fields(scene) if f.name not in ("motions", "vehicle")}
    return {"seconds": [motion.seconds for motion in scene.motions], "vehicle": asdict(scene.vehicle), **rest}
