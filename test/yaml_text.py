"""YAML as PyYAML's safe functions read and write it, by libyaml where there is one: a quarter of the time."""

from __future__ import annotations

from functools import partial

import yaml

LOADER, DUMPER = (yaml.CSafeLoader, yaml.CSafeDumper) if yaml.__with_libyaml__ else (yaml.SafeLoader, yaml.SafeDumper)
parsed = partial(yaml.load, Loader=LOADER)
written = partial(yaml.dump, Dumper=DUMPER)
