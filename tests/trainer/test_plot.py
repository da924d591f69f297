"""Curves read back from progress.csv, and the picture drawn from them."""

import json
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.image import imread

from trainer import plot
from trainer.curves import Curves, closing, read_curves, read_progress
from trainer.errors import CheckpointError, ConfigError

HEADER = "epoch,steps,episodes,episodes_ended,return,cost,return_100,cost_100,multiplier"


def write_run(
    folder: Path, rows: int = 30, level: float = 10.0, multiplier: float = 2.0, tail: str = ""
) -> Path:
    folder.mkdir(parents=True)
    lines = [HEADER, f"1,1000,0,0,,,,,{multiplier}"]
    for i in range(2, rows + 1):
        value = level + np.sin(i)
        lines.append(f"{i},{1000 * i},{i},1,{value},{value / 5},{value},{value / 5},{multiplier}")
    (folder / "progress.csv").write_text("\n".join(lines) + "\n" + tail)
    return folder


def curves(
    steps: list[float], values: list[float], algorithm: str = "cpo", limit: float | None = 1.0
) -> Curves:
    columns = {"steps": np.array(steps, float), "return_100": np.array(values, float)}
    columns |= {"cost_100": columns["return_100"] / 5, "multiplier": np.zeros(len(steps))}
    return Curves(Path("run"), algorithm, limit, 0, columns)


@pytest.mark.parametrize("tail", ["31,31000,31,1,9.1,0.", "31", "31,31000,31,1,9.1,0.2,9.9,0.1,2", "\0\0\0"])
def test_a_line_that_is_still_being_written_is_left_out(tmp_path, tail):
    whole = read_progress(write_run(tmp_path / "whole"))
    torn = read_progress(write_run(tmp_path / "torn", tail=tail))
    for name, values in whole.items():
        np.testing.assert_array_equal(values, torn[name])
    assert np.isnan(whole["return"][0])
    assert whole["steps"][-1] == 30_000


def test_nothing_is_read_beyond_a_damaged_row(tmp_path):
    run = write_run(tmp_path / "run", rows=3, tail="4,4000,oops,1,1,1,1,1,1\n5,5000,5,1,1,1,1,1,1\n")
    assert read_progress(run)["steps"].tolist() == [1000, 2000, 3000]


def test_a_file_with_nothing_but_its_header_has_columns_without_rows(tmp_path):
    (tmp_path / "progress.csv").write_text(HEADER + "\n1,10")
    assert {len(values) for values in read_progress(tmp_path).values()} == {0}


def test_what_a_run_is_comes_from_its_settings_then_from_its_name(tmp_path):
    run = write_run(tmp_path / "trpo-lag-d1.5-s7")
    named = read_curves(run)
    assert (named.algorithm, named.cost_limit, named.seed) == ("trpo-lag", 1.5, 7)
    (run / "config.json").write_text(json.dumps({"algorithm": "cpo", "cost_limit": 2, "seed": 3, "new": 1}))
    told = read_curves(run)
    assert (told.algorithm, told.cost_limit, told.seed) == ("cpo", 2.0, 3)
    (run / "config.json").write_text('{"algorithm": "cp')
    assert read_curves(run).algorithm == "trpo-lag"
    bare = read_curves(write_run(tmp_path / "first try"))
    assert (bare.algorithm, bare.cost_limit, bare.seed) == ("first try", None, None)


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match=r"holds no progress\.csv"):
        read_curves(tmp_path)


@given(
    st.lists(st.tuples(st.integers(0, 40), st.floats(-50, 50), st.floats(0, 50)), max_size=30),
    st.integers(1, 600),
)
def test_closing_figures_are_the_means_over_the_last_episodes(epochs, wanted):
    """All episodes of an epoch alike: then the mean over any of them is known exactly."""
    columns = {
        "episodes_ended": np.array([n for n, _, _ in epochs], float),
        "return": np.array([r if n else np.nan for n, r, _ in epochs], float),
        "cost": np.array([c if n else np.nan for n, _, c in epochs], float),
    }
    episodes = [(r, c) for n, r, c in epochs for _ in range(n)][-wanted:]
    found = closing(columns, wanted)
    if not episodes:
        assert found is None
        return
    assert found.episodes == len(episodes)
    np.testing.assert_allclose([found.mean_return, found.cost], np.mean(episodes, axis=0), atol=1e-9)


@given(
    st.lists(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=12), min_size=1, max_size=4),
    st.sampled_from(["range", "deviation"]),
)
def test_seeds_are_averaged_step_by_step_as_far_as_they_go(seeds, band):
    runs = [curves(list(range(1, len(values) + 1)), values) for values in seeds]
    found = plot.average(runs, "return_100", band)
    for index, step in enumerate(found.steps):
        there = [values[int(step) - 1] for values in seeds if len(values) >= step]
        mean, width = np.mean(there), np.std(there)
        low, high = (min(there), max(there)) if band == "range" else (mean - width, mean + width)
        expected = [mean, low, high]
        actual = [found.mean[index], found.low[index], found.high[index]]
        np.testing.assert_allclose(actual, expected, atol=1e-9)
        assert found.complete[index] == (len(there) == len(seeds))


def test_a_seed_with_other_epochs_is_interpolated_and_never_extended():
    found = plot.average([curves([0, 10, 20], [0, 10, 20]), curves([5, 15], [1, 1])], "return_100", "range")
    assert found.steps.tolist() == [0, 5, 10, 15, 20]
    assert found.mean.tolist() == [0, 3, 5.5, 8, 20]
    assert found.complete.tolist() == [True, True, True, True, False]


def test_gaps_at_the_start_are_no_missing_seed():
    nan = float("nan")
    found = plot.average(
        [curves([1, 2, 3], [nan, 1, 1]), curves([1, 2, 3], [nan, nan, 3])], "return_100", "range"
    )
    assert found.steps.tolist() == [2, 3]
    assert found.complete.all()
    assert plot.average([curves([1, 2], [nan, nan])], "return_100", "range") is None
    assert plot.average([curves([1], [1])], "no such column", "range") is None


@given(st.lists(st.floats(-3, 3), max_size=9), st.floats(0.01, 0.1))
def test_labels_keep_their_order_and_their_distance(heights, gap):
    places = plot.spread(sorted(heights), gap, 0.0, 1.0)
    assert all(b - a >= gap - 1e-9 for a, b in pairwise(places))
    assert all(-1e-9 <= place <= 1.0 + 1e-9 for place in places)


def test_labels_that_have_room_stay_where_they_belong():
    assert plot.spread([0.1, 0.5, 0.9], 0.1, 0.0, 1.0) == [0.1, 0.5, 0.9]


def words(axes):
    return [text.get_text() for text in axes.texts]


def test_panels_are_cost_limits_by_figures_with_the_limit_drawn():
    runs = [curves([1, 2], [3, 4], "cpo", limit) for limit in (2.0, 0.5, 1.0)]
    figure = plot.draw(runs)
    assert len(figure.axes) == 9
    assert [axes.get_title() for axes in figure.axes[:3]] == [f"cost limit d = {d}" for d in (0.5, 1.0, 2.0)]
    assert [axes.get_ylabel() for axes in figure.axes[::3]] == ["return", "cost return", "multiplier λ"]
    for axes, limit in zip(figure.axes[3:6], (0.5, 1.0, 2.0), strict=True):
        assert any(set(line.get_ydata()) == {limit} for line in axes.lines)
    assert words(figure.axes[2]) == ["cpo"]
    assert words(figure.axes[5]) == ["cpo", "limit d"]


def test_an_algorithm_without_a_limit_stands_in_every_panel_and_without_a_multiplier_in_none():
    constrained = [curves([1, 2], [1, 1], "cpo", limit) for limit in (0.5, 1.0)]
    constrained[1].columns["multiplier"][:] = 3.0
    figure = plot.draw([*constrained, curves([1, 2], [7, 7], "ppo", 0.5)])
    for axes in figure.axes[:2]:
        assert any(set(line.get_ydata()) == {7.0} for line in axes.lines)
    assert not any(7.0 in line.get_ydata() for axes in figure.axes[4:] for line in axes.lines)
    assert words(figure.axes[4]) == ["no multiplier"]
    assert words(figure.axes[5]) == ["cpo"]


def test_a_line_that_only_another_column_has_is_named_too():
    figure = plot.draw([curves([1], [1], "cpo", 0.5), curves([1], [1], "ipo", 1.0)])
    assert set(words(figure.axes[1])) == {"ipo", "(cpo)"}


@pytest.mark.parametrize(
    ("top", "ticks"), [(0.3, [0, 0.5, 1]), (7, [0, 0.5, 1, 2, 5]), (300, [0, 0.5, 1, 10, 100])]
)
def test_ticks_of_a_symlog_axis_stay_few(top, ticks):
    assert plot._ticks(top) == ticks


def call(monkeypatch, *arguments) -> int:
    monkeypatch.setattr(sys, "argv", ["lagnet-plot", *map(str, arguments)])
    try:
        plot.main()
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


@pytest.mark.parametrize("suffix", plot.SUFFIXES)
def test_the_command_draws_a_sweep(tmp_path, monkeypatch, suffix):
    for seed in range(2):
        write_run(tmp_path / f"cpo-d0.5-s{seed}", level=5.0 + seed, tail="31,310")
    out = tmp_path / f"picture{suffix}"
    assert call(monkeypatch, tmp_path, "--out", out, "--dpi", 60) == 0
    assert out.stat().st_size > 1000
    if suffix == ".png":
        picture = imread(out)
        assert picture.shape[0] > 300
        assert picture.min() < 0.3


def test_the_command_draws_one_run_in_colours_that_tell_the_bands(tmp_path, monkeypatch, capsys):
    run = write_run(tmp_path / "lagnet-d1.0-s0")
    (tmp_path / "not begun").mkdir()
    out = tmp_path / "one.png"
    assert call(monkeypatch, run, "--out", out, "--band", "deviation", "--scale", "linear", "--dpi", 60) == 0
    assert "1 runs" in capsys.readouterr().err
    orange = np.abs(imread(out)[..., :3] - np.array([0xD5, 0x5E, 0x00]) / 255).max(axis=-1) < 0.05
    assert orange.sum() > 50


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("{run}", "--out", "picture.jpg"), "must end in one of"),
        (("{run}", "--out", "{root}/missing/picture.png"), "cannot write"),
        (("{run}", "--dpi", "0"), "--dpi must be above 0"),
        (("{root}/empty",), "has reported anything yet"),
        (("{root}/nowhere",), "is no folder"),
    ],
)
def test_the_command_says_in_one_line_what_is_wrong(tmp_path, monkeypatch, capsys, arguments, said):
    run = write_run(tmp_path / "cpo-d0.5-s0")
    (tmp_path / "empty").mkdir()
    assert call(monkeypatch, *(each.format(run=run, root=tmp_path) for each in arguments)) == 1
    error = capsys.readouterr().err.strip()
    assert said in error
    assert len(error.splitlines()) == 1


def test_one_run_named_twice_counts_once(tmp_path):
    run = write_run(tmp_path / "cpo-d0.5-s0")
    assert len(plot.find_runs([tmp_path, run, run])) == 1
    with pytest.raises(ConfigError):
        plot.find_runs([])


@pytest.mark.parametrize(
    ("seeds", "said"),
    [
        ([[1, 2, 3]], "over 3 seeds"),
        ([[1, 1]], "over 2 runs of 1 seed;"),
        ([[1, 1, 2]], "over 3 runs of 2 seeds"),
        ([[1, 2], [1, 2, 3]], "over 2 to 3 seeds"),
        ([[None, None]], "over 2 runs;"),
        ([[1], [2]], "mean of the last 100 episodes; λ"),
    ],
)
def test_the_caption_counts_seeds_and_not_runs(seeds, said):
    runs = [
        replace(curves([1, 2], [3, 4], algorithm), seed=seed)
        for algorithm, line in zip(("cpo", "ppo"), seeds, strict=False)
        for seed in line
    ]
    assert said in plot._caption(runs, "range")
