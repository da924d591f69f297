"""Events: one line each, bounded a kind, and nobody waits for whoever reads them."""

from __future__ import annotations

import io
import json
import logging
import os
import threading

import pytest

from server.events import BURST, BURST_SECONDS, Events


def lines(stream: io.StringIO) -> list[dict[str, object]]:
    return [json.loads(line) for line in stream.getvalue().splitlines()]


def test_each_is_one_line_of_json() -> None:
    stream = io.StringIO()
    with Events("json", stream) as events:
        events.tell("state", state="ready", why="two\nlines")
        try:
            raise ValueError("broken")
        except ValueError:
            logging.getLogger("lagnet.test").exception("it failed: %s", "so")
    state, logged = lines(stream)
    assert (state["event"], state["level"], state["why"]) == ("state", "info", "two\nlines")
    assert str(state["time"]).endswith("+00:00")
    assert (logged["event"], logged["level"], logged["message"]) == ("lagnet.test", "error", "it failed: so")
    assert "ValueError: broken" in str(logged["trace"])
    # Afterwards it hears nothing any more.
    logging.getLogger("lagnet.test").error("later")
    assert len(lines(stream)) == 2


def test_as_text_it_tells_people_what_is_wrong_and_nothing_else() -> None:
    stream = io.StringIO()
    with Events("text", stream) as events:
        events.tell("state", state="ready")
        events.tell("alarm", "warning", alarm="risk", value=0.9)
        logging.getLogger("lagnet.test").warning("networks (1 so far): NaN")
    assert stream.getvalue() == "alarm: alarm='risk' value=0.9\nnetworks (1 so far): NaN\n"


def test_of_a_kind_only_so_many_are_told_and_the_next_says_how_many_were_not() -> None:
    stream, now = io.StringIO(), [0.0]
    with Events("json", stream, lambda: now[0]) as events:
        for k in range(BURST + 7):
            events.tell("alarm", number=k)
        events.tell("state")
        now[0] = BURST_SECONDS
        events.tell("alarm", number="later")
        events.tell("alarm", number="last")
    told = [(line["event"], line.get("number"), line.get("left_out")) for line in lines(stream)]
    assert told == [
        *(("alarm", k, None) for k in range(BURST)),
        ("state", None, None),
        ("alarm", "later", 7),
        ("alarm", "last", None),
    ]


def test_kinds_are_bounded() -> None:
    stream = io.StringIO()
    with Events("json", stream, lambda: 0.0) as events:
        for k in range(10_000):
            events.tell(f"kind {k}")
        assert len(events._told) < 300
    assert len(lines(stream)) < 300 + BURST


@pytest.mark.parametrize("end", ["full", "closed"])
def test_nobody_waits_for_a_pipe_that_nobody_reads(end: str) -> None:
    reading, writing = os.pipe()
    if end == "closed":
        os.close(reading)
    stream = os.fdopen(writing, "w")
    done = threading.Event()
    now = [0.0]

    def tell() -> None:
        for k in range(2000):
            now[0] = 100.0 * k
            events.tell("alarm", text="x" * 1000)
        done.set()

    with Events("json", stream, lambda: now[0]) as events:
        threading.Thread(target=tell, daemon=True).start()
        assert done.wait(20.0)
        if end == "full":
            assert events._left_out["alarm"] > 0
            os.close(reading)
    # What could not be written would be tried again, and fail again.
    os.dup2(os.open(os.devnull, os.O_WRONLY), writing)
    stream.close()
