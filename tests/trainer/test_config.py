import dataclasses
import math
import subprocess
import sys

import pytest

from trainer.config import Config, check
from trainer.errors import ConfigError


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"cost_limit": -1.0}, "--cost-limit"),
        ({"learning_rate": 0.0}, "--learning-rate"),
        ({"clip": math.nan}, "--clip"),
        ({"total_steps": 0}, "--total-steps"),
        ({"discount": 1.5}, "--discount"),
        ({"num_envs": 7}, "--num-envs"),
    ],
)
def test_a_bad_setting_is_named(settings, named):
    with pytest.raises(ConfigError, match=named):
        check(dataclasses.replace(Config(), **settings))


def test_defaults_are_sound():
    check(Config())
    assert Config(cost_limit=2.0).state_limit == 0.002


def command(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "trainer.train", *arguments], capture_output=True, text=True, check=False
    )


def test_bad_flags_end_with_a_line_and_no_folder(tmp_path):
    out = tmp_path / "run"
    result = command("--out", str(out), "--minibatch", "0")
    assert result.returncode == 1
    assert "--minibatch must be above 0" in result.stderr
    assert "Traceback" not in result.stderr
    assert not out.exists()


def test_an_unknown_task_ends_with_a_line(tmp_path):
    result = command("--out", str(tmp_path / "run"), "--task", "NoSuchTask-v0", "--no-tensorboard")
    assert result.returncode == 1
    assert "NoSuchTask" in result.stderr
    assert "Traceback" not in result.stderr


def test_help_documents_every_flag():
    result = command("--help")
    assert result.returncode == 0
    text = " ".join(result.stdout.replace("│", " ").split())
    for field in dataclasses.fields(Config):
        assert "--" + field.name.replace("_", "-") in text
    assert "state-wise limit" in text
