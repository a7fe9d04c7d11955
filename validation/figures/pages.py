"""README.md and docs/: what stands between marks is written here, from stored measurements and from the code.

`<!-- NAME -->` ... `<!-- end NAME -->` is the template `blocks/NAME.md`, or what a command of the package prints.
`<!-- {measurement[value]:.2f} -->...<!-- end -->` is such a template by itself, for one figure in running text.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from string import Formatter
from typing import NamedTuple

from dvl_calib_ros.cli.main import main as command_line
from dvl_calib_ros.errors import InputError

from .registry import ROOT
from .stored import FOLDER, Stored, load

_MARKED = re.compile(
    r"<!-- (?P<name>[\w-]+) -->\n(?P<block>.*?)<!-- end (?P=name) -->"
    r"|<!-- (?P<inline>\{[^\n]*?\}) -->(?P<text>[^\n]*?)<!-- end -->",
    re.DOTALL,
)
# Tables that the package prints: what is asked of `dvl-calib parameters`
PRINTED: dict[str, tuple[str, ...]] = {
    "parameters": (),
    **{
        name: (f"--{name}",)
        for name in (
            "models",
            "effects",
            "drivers",
            "findings",
            "doctor",
            "verdicts",
            "comparisons",
            "configurations",
            "selections",
            "unpaired",
            "discoveries",
            "manoeuvres",
            "diagnoses",
            "commands",
        )
    },
}


class Use(NamedTuple):
    """A value on a page. block: the name of a block, or an inline template."""

    page: str
    block: str
    measurement: str
    value: str


def pages() -> list[Path]:
    """README.md and those of docs/."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def template(block: str) -> str | None:
    """Text of a block's template; None if it is printed by the package. Raises InputError if it is neither."""
    if block.startswith("{"):
        return block
    if block in PRINTED:
        return None
    path = FOLDER / "blocks" / f"{block}.md"
    if not path.is_file():
        raise InputError(f"{path}: not there, and `dvl-calib parameters` does not print {block!r} either")
    return path.read_text()


def rendered(block: str) -> str:
    """What stands between the marks of a block. Raises InputError for a value that was not measured."""
    text = template(block)
    if text is None:
        return _printed(*PRINTED[block])
    wanted = dict.fromkeys(measurement for measurement, _ in fields(text))
    try:
        return text.format(**{name: _stored(name) for name in wanted})
    except KeyError as error:
        raise InputError(f"block {block}: {error} is not in validation/figures/*.json; measure it anew") from error


def fields(text: str) -> Iterator[tuple[str, str]]:
    """(measurement, value) of a template's fields."""
    for _, field, _, _ in Formatter().parse(text):
        if field is not None:
            measurement, _, value = field.removesuffix("]").partition("[")
            yield measurement, value


def as_rendered(text: str) -> str:
    """A page's text with every block as it is to be."""

    def replace(found: re.Match[str]) -> str:
        if found["inline"]:
            return f"<!-- {found['inline']} -->{rendered(found['inline'])}<!-- end -->"
        name = found["name"]
        return f"<!-- {name} -->\n{rendered(name)}<!-- end {name} -->"

    return _MARKED.sub(replace, text)


def render() -> list[str]:
    """Write every block into its page, and config/calibration.yaml; what was changed."""
    changed = []
    for page in pages():
        old = page.read_text()
        new = as_rendered(old)
        if new != old:
            page.write_text(new)
            changed.append(page.name)
    config = ROOT / "config" / "calibration.yaml"
    if (new := _printed("--yaml")) != config.read_text():
        config.write_text(new)
        changed.append(config.name)
    return changed


def differing() -> list[str]:
    """Page and block of all that is not what `render` would write."""
    found = []
    for page in pages():
        for each in _MARKED.finditer(page.read_text()):
            block = each["inline"] or each["name"]
            if as_rendered(each[0]) != each[0]:
                found.append(f"{page.name}, block {block}: not what --render writes from validation/figures/*.json")
    return found


def uses() -> list[Use]:
    """Every value on every page; of a measurement whose `rows` are there, all that they show."""
    found = []
    for page in pages():
        for each in _MARKED.finditer(page.read_text()):
            block = each["inline"] or each["name"]
            for measurement, value in fields(template(block) or ""):
                held = (
                    [name for name in _stored(measurement).values if name not in ("at", "rows")]
                    if value == "rows"
                    else [value]
                )
                found += [Use(page.name, block, measurement, each) for each in held]
    return found


def without_blocks(text: str) -> str:
    """A page's text with the blocks blank, their lines kept."""
    return _MARKED.sub(lambda found: re.sub(r"[^\n]", "", found[0]), text)


@cache
def _stored(name: str) -> Stored:
    return load(name)


@cache
def _printed(*options: str) -> str:
    """What `dvl-calib parameters` prints, in this process: a page has many of its tables."""
    printed = io.StringIO()
    with redirect_stdout(printed):
        code = command_line(["parameters", *options])
    if code:
        raise InputError(f"dvl-calib parameters {' '.join(options)}: ended with {code}")
    return printed.getvalue()


def forget() -> None:
    """Read the stored values anew, after some were measured."""
    _stored.cache_clear()
