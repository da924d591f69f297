"""`GET /metrics`: the tally, the alarms and the state, as Prometheus reads them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
)
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.registry import Collector

from decision import Mode, OpenedBy, Origin
from server.alarms import Standing
from server.operation import Operation
from server.states import State
from server.tally import REASONS, Histogram

CONTENT_TYPE = CONTENT_TYPE_PLAIN_0_0_4
MOST_KINDS = 50
"""So many kinds of faults are told apart; all others are one."""
OTHER = "other"
_SECONDS = {
    "request": "From a request's head to its answer.",
    "queue": "From a request's last byte to the begin of its decision.",
    "inference": "The networks, once a request.",
    "filter": "The filter, once a request; next to nothing where the gate is closed.",
}


def exposition(operation: Operation, refusals: Mapping[int, int]) -> Callable[[], bytes]:
    """What writes all metrics in Prometheus' text format.

    Args:
        operation: whose.
        refusals: status → requests that were refused before they came to a decision.
    """
    registry = CollectorRegistry()
    registry.register(_Metrics(operation, refusals))
    ProcessCollector(namespace="lagnet", registry=registry)
    return lambda: generate_latest(registry)


class _Metrics(Collector):
    """Reads an operation when it is asked."""

    def __init__(self, operation: Operation, refusals: Mapping[int, int]) -> None:
        self._operation = operation
        self._refusals = refusals

    def collect(self) -> Iterable[Metric]:
        """All metrics but those of the process."""
        yield from self._requests()
        yield from self._decisions()
        yield from self._faults()
        yield from self._standing()
        yield from self._recorder()

    def _requests(self) -> Iterable[Metric]:
        tally = self._operation.tally
        requests = CounterMetricFamily(
            "lagnet_requests", "Requests for decisions that were answered.", labels=("path", "status")
        )
        refused: dict[int, int] = dict(self._refusals)
        for (path, status), count in sorted(tally.requests.items()):
            requests.add_metric((path, str(status)), count)
            if status != 200:
                refused[status] = refused.get(status, 0) + count
        yield requests
        yield _counter("refusals", "Requests of any kind that were refused.", "status", refused)
        for name, about in _SECONDS.items():
            yield _histogram(f"{name}_seconds", about, tally.seconds[name])

    def _decisions(self) -> Iterable[Metric]:
        tally = self._operation.tally
        all_modes, all_origins, all_opened = tally.modes, tally.origins, tally.opened
        modes = {mode: all_modes[mode] for mode in Mode}
        yield _counter("decisions", "Decisions by what became of the nominal action.", "mode", modes)
        opened = {str(cause): all_opened[cause] for cause in OpenedBy} | {"closed": all_opened[None]}
        yield _counter("gate", "Decisions by what opened the gate.", "opened_by", opened)
        origins = {origin: all_origins[origin] for origin in Origin}
        yield _counter("interventions", "Actions that are not the nominal one.", "origin", origins)
        fallbacks = {kind: tally.fallbacks[kind] for kind in REASONS}
        yield _counter("fallbacks", "Decisions in mode fallback by kind of reason.", "reason", fallbacks)
        yield _histogram("risk", "Risk scores.", tally.risk)
        yield _histogram("barrier_metres", "Barriers; below 0 is not safe.", tally.barrier)
        yield _histogram("novelty", "Novelties; above 1 a sensor shows what it should not.", tally.novelty)
        yield CounterMetricFamily(
            "lagnet_risky_decisions", "Decisions with a risk score above the threshold.", tally.risky
        )
        share = self._operation.gate_share
        if share is not None:
            yield GaugeMetricFamily("lagnet_gate_open_ratio", "Over the last 10 s.", share)

    def _faults(self) -> Iterable[Metric]:
        # Copied at once: decisions in another thread may add to it.
        counts = sorted(
            self._operation.duty.now.monitor.faults.counts.copy().items(), key=lambda kind: -kind[1]
        )
        faults = dict(counts[:MOST_KINDS])
        if rest := sum(count for _, count in counts[MOST_KINDS:]):
            faults[OTHER] = rest
        yield _counter("faults", "What went wrong by kind.", "kind", faults)

    def _standing(self) -> Iterable[Metric]:
        operation = self._operation
        state = GaugeMetricFamily("lagnet_state", "1 for the state the service is in.", labels=("state",))
        for one in State:
            state.add_metric((one,), float(one is operation.states.state))
        yield state
        held = float(operation.states.held is not None)
        yield GaugeMetricFamily("lagnet_held", "1 while every decision is the safe one.", held)
        alarms = GaugeMetricFamily(
            "lagnet_alarm", "1 for the standing of an alarm.", labels=("alarm", "standing")
        )
        values = GaugeMetricFamily("lagnet_alarm_value", "What its limit is for.", labels=("alarm",))
        waiting = GaugeMetricFamily("lagnet_alarm_unacknowledged", "1: nobody saw it.", labels=("alarm",))
        for name, alarm in operation.alarms.alarms.items():
            for standing in Standing:
                alarms.add_metric((name, standing), float(standing is alarm.standing))
            if alarm.value is not None:
                values.add_metric((name,), alarm.value)
            unseen = alarm.standing in (Standing.ACTIVE, Standing.LATCHED) and not alarm.acknowledged
            waiting.add_metric((name,), float(unseen))
        yield from (alarms, values, waiting)
        model = operation.duty.now.model
        told = {"model": model.model, "task": model.task, "algorithm": model.algorithm, "gate": model.gate}
        yield InfoMetricFamily("lagnet_bundle", "What decides.", told | {"guide": model.guide})
        yield GaugeMetricFamily("lagnet_threshold", "The gate `risk` opens above it.", model.threshold)

    def _recorder(self) -> Iterable[Metric]:
        recorder = self._operation.recorder
        if recorder is None:
            return
        told = recorder.status()
        stopped = float(recorder.alarm is not None)
        yield GaugeMetricFamily("lagnet_recorder_stopped", "1 once a recording has stopped.", stopped)
        for name, about in (
            ("dropped", "Exchanges that were not recorded: too many at once."),
            ("recorded", "Exchanges that were written."),
            ("incidents", "Files of incidents that were begun."),
        ):
            if name in told:
                yield CounterMetricFamily(f"lagnet_recorder_{name}", about, told[name])


def _counter(name: str, about: str, label: str, counts: Mapping[Any, int]) -> Metric:
    family = CounterMetricFamily(f"lagnet_{name}", about, labels=(label,))
    for value, count in counts.items():
        family.add_metric((str(value),), count)
    return family


def _histogram(name: str, about: str, histogram: Histogram) -> Metric:
    return HistogramMetricFamily(f"lagnet_{name}", about, histogram.cumulated(), histogram.sum)
