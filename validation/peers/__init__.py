"""Peers of the diagnosis, asked of the same bags side by side: evidence, criterion, sparse regression, correlation.

`streams` reads the bags, `forward` is a model of their own, `search`, `residual` and `answers` what they share;
`evidence`, `bic`, `sparse` and `correlation` are the peers, `asked` asks them; `foreign` records cases outside of the
trial's generator; `scores` joins all with the truth. They need `requirements.txt`, which nothing else does.
"""

from __future__ import annotations

from .command import main

__all__ = ["main"]
