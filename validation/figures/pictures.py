"""The pictures of docs/images, each with the commit that it is of in its metadata. Needs chromium."""

from __future__ import annotations

import io
import json
import re
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dvl_calib_ros.errors import InputError

from .registry import ROOT, by_itself, dvl_calib, snapir_ins
from .sea import GAZEBO, IMPORT, RECORDINGS
from .stored import git, head

if TYPE_CHECKING:
    from rich.console import RenderableType

TARGET = ROOT / "docs" / "images"
HARBOUR_BOX = Path("bags", "harbour_box")  # as it is to stand in a report
COLOURS = 64
WIDTH = 1000  # pixels
BARS = ("#bd1f01", "#ffa90e", "#b9ac70", "#3f90da")

MEASURED = ": measured and explained"  # in the heading of what each effect makes

COMMIT = "commit"  # key of the text in a picture's metadata


def make(names: Sequence[str]) -> None:
    """Make some, or all. Raises InputError for an unknown name, and where chromium is missing."""
    for name in names:
        if name not in PICTURES:
            raise InputError(f"{name!r} is no picture; there are {', '.join(PICTURES)}")
    TARGET.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        for name in names or PICTURES:
            try:
                PICTURES[name](Path(scratch))
            except FileNotFoundError as error:
                raise InputError(f"{error.filename}: not there; pictures need chromium") from error


def not_of_this_history() -> list[str]:
    """Pictures that do not say of which commit they are, or that of another history. Raises InputError without one."""
    from PIL import Image

    git("rev-parse", "HEAD")
    wrong = []
    for path in sorted(TARGET.glob("*.png")):
        with Image.open(path) as image:
            commit = image.info.get(COMMIT)
        if commit is None:
            wrong.append(f"docs/images/{path.name}: says no commit; make it with: figures --pictures")
        elif not _is_ancestor(commit.rstrip("+")):
            wrong.append(f"docs/images/{path.name}: is of commit {commit}, which is not in the history of this tree")
    return wrong


def _is_ancestor(commit: str) -> bool:
    try:
        git("merge-base", "--is-ancestor", commit, "HEAD")
    except InputError:
        return False
    return True


def save(picture: Path, name: str) -> None:
    """As a PNG of few colours, with the commit."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    image = Image.open(picture).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    said = PngInfo()
    said.add_text(COMMIT, head())
    image.save(TARGET / f"{name}.png", optimize=True, pnginfo=said)
    print(f"{name}.png: {image.size}, {(TARGET / f'{name}.png').stat().st_size // 1000} kB")


def screenshot(page: Path, name: str, height: int) -> None:
    """The upper part of a page, in few colours."""
    shot = page.with_suffix(".png")
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--screenshot={shot}"]
    subprocess.run([*command, f"--window-size={WIDTH},{height}", page.as_uri()], check=True, capture_output=True)
    save(shot, name)


def terminal(shown: RenderableType, folder: Path, name: str, title: str, columns: int) -> None:
    """What a terminal of this width shows."""
    from rich.console import Console

    console = Console(record=True, width=columns, file=io.StringIO(), force_terminal=True, highlight=False)
    console.print(shown)
    page = folder / f"{name}.html"
    drawn = console.export_svg(title=title)
    width, height = map(float, re.findall(r'viewBox="0 0 (\S+) (\S+)"', drawn)[0])
    page.write_text(f"<body style='margin:0'>{drawn}</body>")
    screenshot(page, name, round(WIDTH * height / width) + 12)  # below the lowest line


def demo(folder: Path) -> None:
    """The end of the demo."""
    from rich.text import Text

    output = by_itself("demo")
    lines = [line.rstrip() for line in output.splitlines() if not line.startswith("   playing")]
    terminal(Text("\n".join(lines)), folder, "demo", "dvl-calib demo", 104)


def watch(folder: Path) -> None:
    """The live view 250 s into a run."""
    from dvl_calib_ros.bags.reader import BagReader
    from dvl_calib_ros.calibration.calibrator import Calibrator
    from dvl_calib_ros.calibration.models.parameters import Parameters
    from dvl_calib_ros.cli.watch import View
    from dvl_calib_ros.messages.live_feed import MessageFeed
    from dvl_calib_ros.node.diagnostics import RecentCounts, Silence, diagnose
    from dvl_calib_ros.node.operator_card import Card
    from dvl_calib_ros.node.status import Status

    calibrator = Calibrator(Parameters())
    feed = MessageFeed(calibrator, print)
    handlers = {"dvl/twist": feed.dvl, "gnss/twist": feed.reference, "imu/data": feed.imu}
    silence, recent, card, now_s = Silence(0.0, {}), RecentCounts(), Card(0.0), 0.0
    with BagReader([ROOT / HARBOUR_BOX]) as bag:
        first_ns = None
        for topic, log_ns, message, _ in bag.messages(handlers):
            first_ns = first_ns or log_ns
            handlers[topic](message, log_ns)
            if log_ns - first_ns > 1e9 * (now_s + 1.0):
                now_s += 1.0
                found = diagnose(calibrator, feed.decoder.dvl_type, [], silence, recent, now_s, card=card)
            if now_s == 250.0:
                break
    values = {item.key: item.value for item in found.values}
    shown = View(Status(ord(found.level), found.message, values, 0.0), 0.0)
    terminal(shown, folder, "watch", "dvl-calib run --watch", 100)


def report(folder: Path) -> None:
    """The head of replay's report."""
    page = folder / "report.html"
    dvl_calib("replay", HARBOUR_BOX, "--report", page)
    screenshot(page, "report", 1100)


def diagnosis(folder: Path) -> None:
    """The head of a diagnosis' report: a lever arm that nobody has told of."""
    bag, page = folder / "bag", folder / "diagnosis.html"
    dvl_calib("simulate", bag, "--trajectory", "free", "--gnss-std", 0.03, "--effect", "lever_arm:x_m=0.5,y_m=-0.2")
    dvl_calib("diagnose", bag, "--report", page)
    screenshot(page, "diagnosis", 1100)


def real_data(folder: Path) -> None:
    """Of the diagnosis' report of one recording at sea, what each effect makes."""
    page = folder / "real_data.html"
    dvl_calib("import", snapir_ins(), "-o", folder / "sea", *IMPORT)
    dvl_calib("diagnose", folder / "sea" / "T01", "--report", page)
    page.write_text(only_sections(page.read_text(), MEASURED))
    screenshot(page, "real_data", 990)


def only_sections(page: str, title: str) -> str:
    """A report with those of its sections alone in whose heading a title stands. Raises InputError without any."""
    head, begin, body = page.partition("<main>")
    sections = [each for each in re.split("(?=<h2>)", body) if title in each.partition("</h2>")[0]]
    if not sections:
        raise InputError(f"the report has no section {title!r} any more: what is the picture to show?")
    return head + begin + "".join(sections)


def simulators(folder: Path) -> None:
    """Five recordings at sea against a simulator's DVL: the error as it is, with what it lacks, and the noise."""
    from matplotlib.figure import Figure

    from dvl_calib_ros.present.figure_style import drawing

    bags, made, page = folder / "bags", folder / "gz", folder / "simulators.html"
    dvl_calib("import", snapir_ins(), "-o", bags, *IMPORT)
    dvl_calib("simulate", made, *GAZEBO)
    answers = {}
    for name in RECORDINGS:
        report = ["--report", page] if name == "T03" else []
        dvl_calib("diagnose", bags / name, "--simulator", made, "--json", folder / f"{name}.json", *report)
        answers[name] = json.loads((folder / f"{name}.json").read_text())
    screenshot(page, "simulators_report", 1300)
    models = ("as it is", "with lever_arm", "with dvl_time_offset", "all effects")
    with drawing():
        figure = Figure(figsize=(7.0, 3.0))
        axes = figure.add_subplot()
        for place, model in enumerate(models):
            errors = [next(r["error_mps"] for r in a["shrinks"] if r["model"] == model) for a in answers.values()]
            at = [index + 0.2 * (place - 1.5) for index in range(len(answers))]
            axes.bar(at, [1e3 * e for e in errors], 0.18, label=model, color=BARS[place])
        for index, answer in enumerate(answers.values()):
            axes.hlines(1e3 * answer["noise_floor_mps"], index - 0.4, index + 0.4, color="#222222", linestyle=":")
        axes.set_yscale("log")
        axes.set_yticks([5, 10, 20, 50, 100, 200], ["5", "10", "20", "50", "100", "200"])
        axes.minorticks_off()
        axes.set_xticks(range(len(answers)), list(answers))
        axes.set_ylabel("recorded less simulated, mm/s")
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4)
        figure.savefig(folder / "simulators_gap.png", dpi=150)
    save(folder / "simulators_gap.png", "simulators_gap")


PICTURES = {each.__name__: each for each in (demo, watch, report, diagnosis, real_data, simulators)}
