"""The command `lagnet-replay`: a recording as a timeline and a picture, and decided again."""

from __future__ import annotations

import json
import sys
import textwrap
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import tyro
from pydantic_core import from_json
from rich.console import Console

from command import command, settings, terminal, why_not_file
from decision import MEMORY, unpack
from filter import FilterConfig
from models import BundleError
from monitor import Monitor, MonitorError
from recorder import RecordingError
from recorder.reading import Reader, Recorded
from recorder.timeline import Row, Timeline
from server.desk import Desk
from server.duty import UNDECIDED, Duty
from server.keeper import AsItComes
from server.schema import ModelReply

DIFFERENT = 1
"""Exit status where decisions differ."""
TABLE_WIDTH = 120
"""Columns of the table where there is no terminal."""
_NOT_COMPARED = ("seconds", "model")
"""Fields of a reply that are not of the decision."""
_MOST_SHOWN = 5


class ReplayError(ValueError):
    """What cannot be replayed as asked."""


@dataclass(frozen=True)
class ReplayConfig:
    """Shows a recording of lagnet-serve, and decides it again.

    A recording that broke off is read up to there. Decisions are made again with the gate, threshold, guide
    and filter of then.
    """

    file: Annotated[Path, tyro.conf.Positional]
    """A recording: recording-*.mcap or incident-*.mcap."""
    bundle: Path | None = None
    """A bundle to decide again with: bit for bit alike, or where it differs (exit status 1)."""
    all: bool = False
    """Every step, not only where something changes."""
    robot: int | None = None
    """One robot alone. By default the table has all; the picture has the one with the first fallback, or else
    with the most interventions."""
    out: Path | None = None
    """The picture; by default beside the file."""


@dataclass
class Comparison:
    """Recorded decisions beside those that were made again.

    Attributes:
        count: how many.
        differing: how many of them differ.
        undecided: how many more were the service's own: too late, or too old.
        shown: the first that do: what is to be said of each.
    """

    count: int = 0
    differing: int = 0
    undecided: int = 0
    shown: list[str] = field(default_factory=list)


class Again:
    """Decides recorded requests again, as the service did.

    Args:
        bundle: its folder.
        reader: the recording, which tells what decided then: gate, threshold, guide and filter are so again.

    Attributes:
        other: what is not as it was then, in words; None if all is.

    Raises:
        BundleError: if the bundle must not be used.
        MonitorError: if it cannot be run so.
        RecordingError: if the recording does not say what decided.
    """

    def __init__(self, bundle: Path, reader: Reader) -> None:
        model = reader.model
        try:
            gate, threshold, guide = model["gate"], model["threshold"], model["guide"]
            was, files = model["model"], model["sha256"]
            filter_config = FilterConfig(**reader.filter_config)
        except (KeyError, TypeError) as error:
            raise RecordingError(f"the recording is of another version of lagnet-serve: {error}") from error
        monitor = Monitor.load(bundle, gate, threshold, filter_config, guide)
        now = ModelReply.of(monitor)
        self._desk = Desk(_nobody, Duty(monitor, now), AsItComes())
        self.comparison = Comparison()
        self.other = None
        if now.sha256 != files:
            self.other = f"another bundle: {was} decided then, {now.model} decides now"

    def compare(self, recorded: Recorded, wanted: set[int], seconds: float) -> None:
        """Decides a request again.

        Args:
            recorded: with the reply that it was given then.
            wanted: the robots whose decisions are compared.
            seconds: when that was, to be said where they differ.
        """
        batch = b'"robots"' in recorded.request and "robots" in from_json(recorded.request)
        answer = self._desk.answer(recorded.request, batch).body
        then, now = _decisions(recorded.reply), _decisions(answer)
        numbers = [decision["robot"] for decision in recorded.decisions]
        for place in range(max(len(then), len(now))):
            robot = numbers[place] if place < len(numbers) else place
            if robot not in wanted:
                continue
            one, two = (told[place] if place < len(told) else {} for told in (then, now))
            if (one.get("reason") or "").startswith(UNDECIDED):
                self.comparison.undecided += 1
                continue
            self.comparison.count += 1
            if differences := _differences(one, two):
                self.comparison.differing += 1
                if len(self.comparison.shown) < _MOST_SHOWN:
                    self.comparison.shown.append(f"{seconds:.3f} s, robot {robot}: {'; '.join(differences)}")


def _decisions(reply: bytes) -> list[dict[str, Any]]:
    """What a reply tells of each robot that was decided about, or of the fault."""
    told = from_json(reply)
    return [each for each in told.get("replies", [told]) if "mode" in each or "replies" not in told]


def _differences(then: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Fields in which two decisions differ, in words; as JSON, numbers are what they are, bit for bit."""
    differences = []
    for name in {**then, **now}:
        one, two = (json.dumps(told.get(name)) for told in (then, now))
        if name == "memory":
            differences += [f"memory differs in {part}" for part in _memories_differ(then, now)]
        elif name not in _NOT_COMPARED and one != two:
            differences.append(f"{name} was {one}, is {two}")
    return differences


def _memories_differ(then: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """The parts in which two decisions' memories differ, bit for bit; their seals are each service's own."""
    if "memory" not in then or "memory" not in now:
        return ["all"]
    one, two = unpack(then["memory"])[0], unpack(now["memory"])[0]
    names = [name for name in MEMORY.names or () if name != "seal"]
    return [name for name in names if one[name].tobytes() != two[name].tobytes()]


async def _nobody(*_: object) -> None:
    """Answers nothing: only decisions are asked for."""


def replay(config: ReplayConfig, console: Console) -> bool:
    """Shows a recording and decides it again; whether all decisions are as they were.

    Raises:
        ReplayError: if it cannot be shown as asked.
        RecordingError: if the file is no recording.
        BundleError: if the bundle must not be used.
        MonitorError: if it cannot be run as then.
    """
    picture = config.out or config.file.with_suffix(".png")
    if (why := why_not_file(picture)) is not None:
        raise ReplayError(
            f"the picture {picture} {why}" + ("" if config.out else ": --out says where it goes")
        )
    try:
        reader = Reader(config.file)
    except OSError as error:
        raise ReplayError(f"{config.file}: {error.strerror}") from error
    with reader:
        again = None if config.bundle is None else Again(config.bundle, reader)
        timeline = _read(reader, config, again)
    if not timeline.rows:
        raise ReplayError(f"{config.file}: no decision" + _of_robot(config, timeline))
    _tell(reader, timeline, console)
    console.print(timeline.table(config.all))
    _draw(picture, timeline, reader, config, console)
    return again is None or _told_again(again, console)


def _of_robot(config: ReplayConfig, timeline: Timeline) -> str:
    return "" if config.robot is None else f" about robot {config.robot}"


def _read(reader: Reader, config: ReplayConfig, again: Again | None) -> Timeline:
    """The file's decisions; each is decided again on the way, if that is asked for."""
    timeline: Timeline | None = None
    for recorded in reader.exchanges():
        if timeline is None:
            at = recorded.received if reader.incident is None else int(reader.incident["at"])
            timeline = Timeline(at)
        rows = [Row.of(recorded.received, decision) for decision in recorded.decisions]
        wanted = [row for row in rows if config.robot in (None, row.robot)]
        timeline.rows += wanted
        if again is not None and wanted:
            again.compare(recorded, {row.robot for row in wanted}, timeline.seconds(wanted[0]))
    return timeline or Timeline(0)


def _tell(reader: Reader, timeline: Timeline, console: Console) -> None:
    """What the file is, and what is not in it."""
    first, last = timeline.rows[0], timeline.rows[-1]
    robots = timeline.robots()
    console.print(
        f"{len(timeline.rows)} decisions about {len(robots)} robot{'s' * (len(robots) != 1)}, "
        f"{_utc(first.at)} and {(last.at - first.at) / 1e9:.1f} s on; "
        f"{reader.model.get('model')}, gate {reader.model.get('gate')}"
    )
    if reader.incident is not None:
        console.print(f"incident at {_utc(timeline.zero)}, which is 0 s: {reader.incident['reason']}")
    if not reader.ended:
        console.print("the file breaks off: its writer was killed, or still writes it", style="yellow")
    if reader.damaged:
        console.print(f"{reader.damaged} stretches of the file are damaged and left out", style="yellow")
    if reader.missing:
        console.print(f"{reader.missing} requests in between are not in the file", style="yellow")


def _draw(picture: Path, timeline: Timeline, reader: Reader, config: ReplayConfig, console: Console) -> None:
    from recorder.picture import draw

    robot = timeline.of_most_interest() if config.robot is None else config.robot
    what = "" if reader.incident is None else textwrap.shorten(reader.incident["reason"], 120) + "\n"
    title = f"{what}robot {robot}, one of {len(timeline.robots())}, {_utc(timeline.zero)}"
    try:
        draw(picture, timeline, robot, title, reader.model.get("action_high", (1.0, 1.0)))
    except ImportError:
        console.print("no picture: matplotlib is not installed (pip install 'lagnet[train]')", style="yellow")
    except OSError as error:
        raise ReplayError(f"the picture {picture} cannot be written: {error.strerror}") from error
    else:
        console.print(f"robot {robot}: {picture}")


def _told_again(again: Again, console: Console) -> bool:
    found = again.comparison
    if again.other is not None:
        console.print(again.other, style="yellow")
    if found.undecided:
        console.print(
            f"{found.undecided} fallbacks are the service's own (deadline, freshness) and are not compared"
        )
    if not found.differing:
        console.print(f"{found.count} of {found.count} decisions equal bit for bit", style="green")
        return True
    console.print(f"{found.differing} of {found.count} decisions differ; the first:", style="red")
    for line in found.shown:
        console.print(f"  {line}")
    return False


def _utc(nanoseconds: int) -> str:
    return datetime.fromtimestamp(nanoseconds / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S.%f")[:-3] + " UTC"


def main() -> None:
    """Entry point of `lagnet-replay`: 0; 1 where decisions differ; 2 for what cannot be replayed."""
    with command("lagnet-replay", ReplayError, RecordingError, BundleError, MonitorError):
        config = settings(ReplayConfig, "lagnet-replay")
        console = terminal(stderr=False, width=None if sys.stdout.isatty() else TABLE_WIDTH)
        if not replay(config, console):
            sys.exit(DIFFERENT)


if __name__ == "__main__":
    main()
