"""Who draws from which stream of random numbers, so that no two uses share one. Needs numpy alone.

Every stream is a child of a user's seed by numpy's `SeedSequence`, its spawn key the use and the row. Were
rows seeded with s, s + 1, ..., runs of neighbouring seeds would have all layouts but one in common.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

_ROWS, _REST = 0, 1


class Use(IntEnum):
    """What random numbers are for.

    A value is part of its streams: it never changes, and none is given twice. *The rest* is everything random
    but layouts and goals.
    """

    TRAINING = 1
    """Training; the rest: initial weights, exploration noise, minibatches."""
    CALIBRATION = 2
    """An export's threshold and figures; the rest: the states on which it compares torch and ONNX."""
    COMPARISON = 3
    """`benchmarks.algorithms`: finished runs side by side."""
    EVALUATION = 4
    """`lagnet-evaluate`; the rest: the states on which decisions are timed."""
    DEMO = 5
    """The demo, likewise."""
    FILTER = 6
    """`benchmarks.filter_closed_loop`; the rest: faults of the sensors, random policies."""
    SIMULATION_SPEED = 7
    """`benchmarks.simulation`; the rest: its actions."""
    FILTER_SPEED = 8
    """The rest alone: the scenes that `benchmarks.filter` makes up."""
    WARNING = 9
    """The drives on which λ is fitted to warn; the rest: disturbances, weights, minibatches."""
    GATE = 10
    """`lagnet-calibrate`: the closed loops by which a gate is chosen; the rest: the states on which
    decisions are timed, and of which episodes of a log the scores are kept."""
    WARNING_REPORT = 11
    """`lagnet-calibrate --report`: how well λ warns."""
    NETWORK_SPEED = 12
    """`benchmarks.networks`: the states that it runs on."""
    EXCHANGE = 13
    """The rest alone: how `lagnet-calibrate --check` orders equal scores."""
    NOVELTY = 14
    """`lagnet-calibrate --novelty`: what a policy's own drives look like."""
    SENSORS = 15
    """`benchmarks.sensors`; the rest: which sensor fails when, and how."""
    SOAK = 16
    """`benchmarks.soak`."""


def rows(use: Use, seed: int, count: int) -> list[int]:
    """Seeds for the rows of a vector environment, or for one episode after the other.

    Args:
        use: what for.
        seed: the user's, at least 0.
        count: how many; the first ones stay the same whatever it is.

    Returns:
        Numbers below 2^128, which `reset` of an environment takes, one a row.

    Raises:
        ValueError: if the seed is negative.
    """
    return _numbers(seed, (use, _ROWS), count)


def generator(use: Use, seed: int) -> np.random.Generator:
    """For the rest: everything random in a use but layouts and goals.

    Raises:
        ValueError: if the seed is negative.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(use, _REST)))


def spawn(seed: int, count: int) -> list[int]:
    """Seeds for the rows of a vector environment whose `reset` got one number: children of no use.

    Args:
        seed: at least 0.
        count: how many; the first ones stay the same whatever it is.

    Returns:
        Numbers below 2^128.

    Raises:
        ValueError: if the seed is negative.
    """
    return _numbers(seed, (), count)


def _numbers(seed: int, key: tuple[int, ...], count: int) -> list[int]:
    """128 bits of each child of the sequence with that spawn key: as much as a `SeedSequence` keeps."""
    children = np.random.SeedSequence(seed, spawn_key=key).spawn(count)
    return [int.from_bytes(child.generate_state(4).astype("<u4").tobytes(), "little") for child in children]
