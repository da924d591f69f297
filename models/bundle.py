"""Writing and loading a bundle: a folder of two ONNX graphs and their manifest."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from models.errors import BundleError
from models.graph import FLOAT, Graph, Tensor, check_graph, read_graph
from models.join import join
from models.manifest import (
    FORMAT_VERSION,
    MANIFEST_FILE,
    MULTIPLIER_FILE,
    NAME,
    NOVELTY_FILE,
    POLICY_FILE,
    Manifest,
)


@dataclass(frozen=True)
class Bundle:
    """A checked bundle. The graphs' bytes are kept, so that what was checked is what runs.

    Attributes:
        path: its folder.
        manifest: what it says about itself.
        policy: the bytes of policy.onnx: "observation" [batch, O] → "action" [batch, 2], the mean action
            within bounds.
        multiplier: the bytes of multiplier.onnx: "observation" [batch, O] → "multiplier" [batch], λ_ξ(s) ≥ 0
            (paper eq. 14).
        novelty: the bytes of novelty.npz, what is normal for the policy on its robot; None: nobody found out.
        id: name and the first 12 digits of the SHA-256 of manifest.json, which covers the graphs' digests.
    """

    path: Path
    manifest: Manifest
    policy: bytes
    multiplier: bytes
    novelty: bytes | None
    id: str

    @property
    def policy_path(self) -> Path:
        """Where policy.onnx lies."""
        return self.path / POLICY_FILE

    @property
    def multiplier_path(self) -> Path:
        """Where multiplier.onnx lies."""
        return self.path / MULTIPLIER_FILE

    def joined(self) -> bytes:
        """Both networks as one graph, "observation" → "action" and "multiplier", bit for bit as apart.

        Raises:
            BundleError: if a graph has subgraphs or functions.
        """
        try:
            return join((self.policy, self.multiplier))
        except BundleError as error:
            raise BundleError(f"{self.path}: {error}") from error

    @staticmethod
    def load(path: str | Path) -> Bundle:
        """Loads a bundle and checks everything that can be checked without running it.

        Args:
            path: the bundle's folder.

        Raises:
            BundleError: one line that names the file and what is wrong: a file is missing, the manifest is
                malformed or of another format version, a digest differs, a graph is no valid ONNX, keeps
                data outside the file, uses another opset than stated, or has other inputs or outputs than the
                layout asks for.
        """
        folder = Path(path)
        if not folder.is_dir():
            raise BundleError(
                f"{folder}: no such bundle (a folder with {MANIFEST_FILE}, {POLICY_FILE}, {MULTIPLIER_FILE})"
            )
        text = _read(folder / MANIFEST_FILE)
        manifest = _parse_manifest(folder / MANIFEST_FILE, text)
        policy = _read_checked(folder / POLICY_FILE, manifest)
        multiplier = _read_checked(folder / MULTIPLIER_FILE, manifest)
        _check_graph(folder / POLICY_FILE, policy, manifest, Tensor("action", FLOAT, (None, 2)))
        _check_graph(folder / MULTIPLIER_FILE, multiplier, manifest, Tensor("multiplier", FLOAT, (None,)))
        novelty = _read_checked(folder / NOVELTY_FILE, manifest) if manifest.novelty else None
        identity = f"{manifest.name}@{hashlib.sha256(text).hexdigest()[:12]}"
        return Bundle(folder, manifest, policy, multiplier, novelty, identity)


def write_bundle(
    path: str | Path,
    policy_onnx: bytes,
    multiplier_onnx: bytes,
    manifest: Manifest,
    novelty: bytes | None = None,
) -> Bundle:
    """Writes a bundle beside its final place, loads it back, and only then renames it into place.

    Args:
        path: the folder to create; an existing bundle there is replaced, a folder that holds anything else
            is refused.
        policy_onnx: the bytes of policy.onnx.
        multiplier_onnx: the bytes of multiplier.onnx.
        manifest: what to write as manifest.json; its sha256 is computed here.
        novelty: the bytes of novelty.npz, which the manifest then has to say the source of; None: there is
            none.

    Returns:
        The bundle, loaded from its final place.

    Raises:
        BundleError: if the place is taken or cannot be written, or the bundle would not load.
    """
    target = Path(path)
    check_target(target)
    digests = {POLICY_FILE: _digest(policy_onnx), MULTIPLIER_FILE: _digest(multiplier_onnx)}
    if novelty is not None:
        digests[NOVELTY_FILE] = _digest(novelty)
    if (novelty is None) != (manifest.novelty is None):
        raise BundleError(f"{target}: novelty.npz and the manifest's novelty come together or not at all")
    try:
        complete = Manifest.model_validate(manifest.model_dump() | {"sha256": digests}).to_json()
    except ValidationError as error:
        reason = "; ".join(detail["msg"] for detail in error.errors())
        raise BundleError(f"{target}: its manifest would contradict itself: {reason}") from error
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
        try:
            fresh = temporary / "new"
            fresh.mkdir()
            (fresh / POLICY_FILE).write_bytes(policy_onnx)
            (fresh / MULTIPLIER_FILE).write_bytes(multiplier_onnx)
            if novelty is not None:
                (fresh / NOVELTY_FILE).write_bytes(novelty)
            (fresh / MANIFEST_FILE).write_text(complete, encoding="utf-8")
            _check(fresh, target)
            _move_into_place(fresh, target, aside=temporary / "old")
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        raise BundleError(f"{target}: cannot be written: {error.strerror or error}") from error
    return Bundle.load(target)


def check_target(target: Path) -> None:
    """Refuses a place where no bundle can be written, before there is one to write.

    What is not part of a bundle would be lost with the folder that it lies in.

    Raises:
        BundleError: if its name is none for a bundle, or the place is taken by anything else.
    """
    name = target.resolve().name
    if re.fullmatch(NAME, name) is None:
        raise BundleError(
            f"{target}: {name!r} is no name for a bundle: expected letters, digits, dots, dashes and "
            "underscores, at most 64, a letter or a digit first"
        )
    if not target.exists():
        return
    if not (target / MANIFEST_FILE).is_file():
        raise BundleError(f"{target}: exists and is not a bundle; not replaced")
    own = {MANIFEST_FILE, POLICY_FILE, MULTIPLIER_FILE, NOVELTY_FILE}
    foreign = sorted({entry.name for entry in target.iterdir()} - own)
    if foreign:
        raise BundleError(f"{target}: holds {foreign[0]}, which is no part of a bundle; not replaced")


def _check(fresh: Path, target: Path) -> None:
    """Loads what was just written; an error names the place that the caller asked for."""
    try:
        Bundle.load(fresh)
    except BundleError as error:
        raise BundleError(str(error).replace(str(fresh), str(target))) from error


def _move_into_place(fresh: Path, target: Path, aside: Path) -> None:
    """Renames a folder to its final name; one that had the name goes aside, and comes back if that fails."""
    if not target.exists():
        fresh.rename(target)
        return
    target.rename(aside)
    try:
        fresh.rename(target)
    except OSError:
        aside.rename(target)
        raise


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise BundleError(f"{path}: cannot be read: {error.strerror or error}") from error


def _parse_manifest(path: Path, text: bytes) -> Manifest:
    try:
        raw = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BundleError(f"{path}: not JSON: {error}") from error
    version = raw.get("format_version") if isinstance(raw, dict) else None
    if version != FORMAT_VERSION:
        raise BundleError(
            f"{path}: format_version is {version!r}, this version of lagnet reads {FORMAT_VERSION}"
        )
    try:
        return Manifest.model_validate_json(text, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise BundleError(f"{path}: {where + ': ' if where else ''}{first['msg']}") from error


def _read_checked(path: Path, manifest: Manifest) -> bytes:
    stated = manifest.sha256.get(path.name)  # type: ignore[call-overload]
    if stated is None:
        raise BundleError(f"{path.parent / MANIFEST_FILE}: sha256 of {path.name} is missing")
    data = _read(path)
    found = _digest(data)
    if found != stated:
        raise BundleError(
            f"{path}: sha256 is {found[:12]}…, the manifest says {stated[:12]}…: changed since export"
        )
    return data


def _check_graph(path: Path, data: bytes, manifest: Manifest, output: Tensor) -> None:
    try:
        _compare(read_graph(data), manifest, output)
        check_graph(data)
    except BundleError as error:
        raise BundleError(f"{path}: {error}") from error


def _compare(graph: Graph, manifest: Manifest, output: Tensor) -> None:
    """Holds what a graph declares against what the manifest asks for."""
    observation = Tensor("observation", FLOAT, (None, manifest.observation_size))
    if graph.external:
        raise BundleError("keeps tensors outside the file (ONNX external data), which is refused")
    if graph.opsets != {"": manifest.opset}:
        stated = ", ".join(f"{domain or 'ai.onnx'} {version}" for domain, version in graph.opsets.items())
        raise BundleError(f"uses opset {stated}, the manifest says ai.onnx {manifest.opset}")
    for what, found, expected in (("input", graph.inputs, observation), ("output", graph.outputs, output)):
        if found != (expected,):
            listed = ", ".join(str(tensor) for tensor in found) or "none"
            raise BundleError(f"{what} is {listed}, expected {expected}")
