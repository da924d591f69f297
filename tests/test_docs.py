"""What README and docs tell a reader to type."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from server.schema import ActRequest

ROOT = Path(__file__).parents[1]
CURLS = [
    (path.name, line)
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
    for line in path.read_text().splitlines()
    if "/act " in line and "curl" in line
]


@pytest.mark.parametrize(("name", "line"), CURLS, ids=[f"{name}-{i}" for i, (name, _) in enumerate(CURLS)])
def test_what_curl_sends_is_a_request(name: str, line: str) -> None:
    """As a shell makes it: from a pipe, or in the line itself."""
    if "|" in line:
        makes, sends = line.split("|")
        assert re.search(r"-d ?@-", sends)
        python = sys.executable if makes.startswith("python ") else "no python"
        command = [python, *shlex.split(makes)[1:]]
        body = subprocess.run(command, capture_output=True, check=True, text=True).stdout
    else:
        words = shlex.split(line)
        body = words[words.index("-d") + 1]
    assert len(ActRequest.model_validate_json(body).observation) == 60


def test_there_is_one() -> None:
    assert CURLS
