import json
from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from inference import Networks
from inference.cut import Cut
from models import Bundle
from models.features import read
from trainer import export, onnx_graph
from trainer.config import Config
from trainer.errors import CheckpointError, ExportError
from trainer.export import ExportConfig, TrainedRun
from trainer.train import train
from trainer.warning import WarningConfig

SETTINGS = {
    "total_steps": 400, "num_envs": 4, "epoch_steps": 200, "minibatch": 100, "passes": 1, "threads": 1,
    "tensorboard": False,
}  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    train(Config(algorithm="lagnet-foresight", out=folder, **SETTINGS))
    return folder


@pytest.fixture(scope="module")
def bundle(run):
    target = run.parent / "bundle"
    export.export(ExportConfig(run, target, episodes=3, threads=1, warning_episodes=0))
    return Bundle.load(target)


def test_the_bundle_says_what_it_is(bundle):
    manifest = bundle.manifest
    assert (manifest.task, manifest.level, manifest.algorithm) == ("PointGoal1-v0", 1, "lagnet-foresight")
    assert manifest.training["total_steps"] == 400
    assert manifest.figures["episodes"] == 3
    assert {"return", "cost", "steps", "onnx_difference_action"} <= manifest.figures.keys()
    assert manifest.threshold == 0
    assert manifest.threshold_source.startswith("gate always open")
    json.dumps(manifest.training)


def test_the_graphs_compute_what_torch_computes(run, bundle):
    trained = TrainedRun(run)
    rng = np.random.default_rng(0)
    observation = rng.normal(0, 3, (50, 60)).astype(np.float32)
    observation[:, 12:] = rng.random((50, 48))  # lidar readings
    for data, name, expected in (
        (bundle.policy, "action", trained.actions(observation)),
        (bundle.multiplier, "multiplier", trained.multipliers(observation)),
    ):
        session = onnxruntime.InferenceSession(data)
        (whole,) = session.run([name], {"observation": observation})
        (one,) = session.run([name], {"observation": observation[:1]})
        np.testing.assert_allclose(whole, expected, atol=1e-5)
        np.testing.assert_allclose(one, whole[:1], atol=1e-6)
    assert (np.abs(trained.actions(observation)) <= 1).all()
    assert (trained.multipliers(observation) >= 0).all()


@pytest.mark.parametrize("precision", ["single", "double"])
def test_the_graphs_say_what_their_features_are(run, bundle, precision, caplog):
    trained = TrainedRun(run)
    policy, multiplier = (
        (bundle.policy, bundle.multiplier) if precision == "single" else trained.graphs("double")
    )
    said = [read(onnx.load_from_string(graph)) for graph in (policy, multiplier)]
    assert said[0] == said[1] == onnx_graph.numbers(trained.learner.features)
    assert all("features" not in names(graph) for graph in (policy, multiplier))
    networks = Networks(replace(bundle, policy=policy, multiplier=multiplier))
    assert "lagnet" not in {record.name.split(".")[0] for record in caplog.records}
    assert isinstance(networks._answer, Cut)
    observation = np.random.default_rng(0).random((50, 60))
    action, risk = networks.run(observation)
    np.testing.assert_allclose(action, trained.actions(observation.astype(np.float32)), atol=1e-5)
    np.testing.assert_allclose(risk, trained.multipliers(observation.astype(np.float32)), atol=1e-5)


def names(graph):
    """Of a graph's inputs and outputs."""
    graph = onnx.load_from_string(graph).graph
    return [value.name for value in (*graph.input, *graph.output)]


@pytest.mark.long
def test_the_graphs_are_exact_for_a_policy_that_reacts_steeply(run):
    trained = TrainedRun(run)
    rng = np.random.default_rng(0)
    observation = rng.normal(0, 3, (1000, 60)).astype(np.float32)
    observation[:, 12:] = rng.random((1000, 48))
    single, _ = export.graphs(trained, observation)
    assert onnx.TensorProto.DOUBLE not in types(single[0])
    with torch.no_grad():
        trained.learner.actor.mul_(12)
    double, differences = export.graphs(trained, observation)
    assert onnx.TensorProto.DOUBLE in types(double[0])
    # Of what is drawn; on the way out of the dead zone what is sent moves farther.
    assert differences["onnx_difference_action"] < 1e-6 * trained.range.gain.max()


def types(graph: bytes) -> set[int]:
    """Data types of a graph's constants."""
    return {tensor.data_type for tensor in onnx.load_model_from_string(graph).graph.initializer}


@pytest.mark.long
def test_by_default_what_is_exported_warns(run, tmp_path, monkeypatch):
    monkeypatch.setattr(export, "WarningConfig", lambda episodes: WarningConfig(episodes, minibatches=50))
    asked = ExportConfig(run, tmp_path / "bundle", episodes=2, threads=1, warning_episodes=1)
    manifest = export.export(asked)
    assert manifest.multiplier_source.startswith("fitted with the policy frozen")
    assert manifest.figures["warning_states"] > 3000
    assert manifest.figures["onnx_difference_multiplier"] <= export.TOLERANCE
    bundle = Bundle.load(tmp_path / "bundle")
    observation = np.zeros((2, 60), np.float32)
    (risk,) = onnxruntime.InferenceSession(bundle.multiplier).run(None, {"observation": observation})
    assert ((risk > 0.0) & (risk < 1.0)).all()


def test_graphs_that_differ_are_refused(run, tmp_path, monkeypatch):
    honest = TrainedRun.graphs

    def shifted(self, precision):
        graphs = honest(self, precision)
        with torch.no_grad():
            self.learner.actor[:100] += 0.01
        return graphs

    monkeypatch.setattr(TrainedRun, "graphs", shifted)
    with pytest.raises(ExportError, match=r"differ by .* in the action"):
        export.export(ExportConfig(run, tmp_path / "bundle", episodes=2, threads=1, warning_episodes=0))
    assert not (tmp_path / "bundle").exists()


def test_an_algorithm_without_multiplier_network_leaves_the_gate_open(tmp_path, caplog):
    train(Config(algorithm="ppo", out=tmp_path / "run", **SETTINGS))
    manifest = export.export(
        ExportConfig(tmp_path / "run", tmp_path / "bundle", episodes=2, threads=1, warning_episodes=0)
    )
    assert manifest.threshold < export.NO_NETWORK
    assert "no multiplier network" in manifest.threshold_source
    bundle = Bundle.load(tmp_path / "bundle")
    assert Networks(bundle).run(np.zeros((1, 60)))[1] == export.NO_NETWORK
    assert "lagnet" not in {record.name.split(".")[0] for record in caplog.records}


def test_what_cannot_be_a_bundle_is_refused(tmp_path, tiny_task):
    config = Config(algorithm="scpo", out=tmp_path / "scpo", **SETTINGS)
    train(config)
    with pytest.raises(ExportError, match="cannot be exported"):
        export.export(ExportConfig(tmp_path / "scpo", tmp_path / "bundle"))
    train(
        replace(config, algorithm="ppo", out=tmp_path / "tiny", task="Tiny"), lambda c: tiny_task(c.num_envs)
    )
    with pytest.raises(ExportError, match="not Tiny"):
        export.export(ExportConfig(tmp_path / "tiny", tmp_path / "bundle"))
    with pytest.raises(CheckpointError, match="no run"):
        export.export(ExportConfig(tmp_path / "nowhere", tmp_path / "bundle"))
