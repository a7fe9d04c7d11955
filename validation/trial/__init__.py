"""The blind trial: bags from a generator of its own, diagnosed without the truth, and scored afterwards.

`motion`, `recorded`, `vehicle` and `strength` repeat physics on purpose: a diagnosis that is tested with the code it
was built on would be tested for nothing. They share no code with `effects`, `simulation` and `diagnosis`.

`plan` says which cases there are, `simulated` and `half_real` draw them (`cases`), `generator` records them, `run`
asks, `scored`, `figures` and `tables` join the answers with the truth.
"""

from __future__ import annotations

from .command import main

__all__ = ["main"]
