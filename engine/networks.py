"""Load networks from a folder or, with the user's consent, from Hugging Face's hub: which are known, and their files.
Only safetensors are read: no pickles, and no code that comes with a model. A name stands for one revision. transformers
is imported late, when a network is loaded."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from traceback import walk_tb
from typing import Any

from .errors import PlgsError, lacks_memory, lacks_part
from .job import write_atomically
from .job.atomic import sha256 as digest_of
from .json_file import read_object
from .known_networks import KNOWN

ANOTHER = "Name another model, or download this one again."
_IS_COMMIT = re.compile("[0-9a-f]{40}")
_HUB_S = 15.0
"""Seconds within which huggingface.co must answer."""
_REPEATS = re.compile("layers?$|blocks$|^depths?$|^num_stages$")  # options that count layers or blocks (or list counts)
_CLASSES = ("id2label", "label2id")
_MOST_REPEATS = 1000
_MOST_IN = {"config.json": 2**20, "preprocessor_config.json": 2**13}
"""The largest number in a model's settings: of features, words and the like, and of pixels."""


def quiet_transformers(name: str, download: bool, part: str, purpose: str) -> None:
    """Import transformers with its output switched off and, without ``download``, its access to the hub. Raises
    PlgsError if ``name`` is neither a folder nor a model's name, and if transformers is missing. The error names the
    ``purpose`` and the engine's ``part``."""
    model = name.partition("@")[0]
    if not Path(name).is_dir() and (model.count("/") != 1 or model.startswith((".", "/", "~"))):
        fix = "Name a folder, or a model as OWNER/NAME or OWNER/NAME@REVISION."
        raise PlgsError("no-model", "there is no such folder or model", name, fix)
    if not download:  # the library reads this when it is imported
        os.environ["HF_HUB_OFFLINE"] = "1"
    try:
        from transformers.utils import logging
    except ImportError as error:
        raise lacks_part(f"{purpose} with the package transformers ({error})", name, part) from error
    logging.set_verbosity_error()
    logging.disable_progress_bar()


def refuse_missing(name: str, purpose: str, *, download: bool) -> None:
    """Raise PlgsError, before any work, if network ``name`` could not be loaded later for its ``purpose``: it is not on
    this machine and may not be fetched or is not offered, or transformers is missing."""
    quiet_transformers(name, download, "segment", purpose)
    if not download:
        model_folder(name, download=False)
    elif not is_here(name):
        from huggingface_hub import HfApi

        model, _, revision = name.partition("@")
        _ask_hub(HfApi(), model, revision or None)


def is_here(name: str) -> bool:
    """Whether a network is on this machine already, found out without asking the hub."""
    if Path(name).is_dir():
        return True
    if find_spec("huggingface_hub") is None:
        return False
    try:
        model_folder(name, download=False)
    except PlgsError:
        return False
    return True


@contextmanager
def loading(name: str, *, runs: bool = False) -> Iterator[None]:
    """Turn errors of transformers and its libraries in a ``with`` block into PlgsError about ``name``: files that they
    cannot load or, if ``runs``, a network that they cannot run. Errors of our own code while it ``runs`` are bugs and
    stay."""
    try:
        yield
    except Exception as error:  # they have dozens of kinds, some of their own
        lines = str(error).splitlines() or [type(error).__name__]
        *_, (innermost, _) = walk_tb(error.__traceback__)
        is_ours = runs and Path(innermost.f_code.co_filename).is_relative_to(Path(__file__).parent)
        if isinstance(error, PlgsError) or lacks_memory(error) or is_ours:
            raise
        raise PlgsError("model-unusable", f"the model cannot be used ({lines[0][:200]})", name, ANOTHER) from error


def model_folder(name: str, *, download: bool) -> Path:
    """Return the folder with a model's files: ``name`` itself, or its files from the hub, which are fetched only with
    ``download``. Raises PlgsError if they are missing or were changed, OSError."""
    from huggingface_hub import HfApi, constants, snapshot_download

    folder, (model, _, revision) = Path(name), name.partition("@")
    if not folder.is_dir():
        pin = Path(constants.HF_HUB_CACHE) / f"models--{model.replace('/', '--')}" / "plgs.json"
        pins: dict[str, Any] = read_object(pin, "Delete it.") if pin.is_file() else {}
        # What a name stands for may change on the hub: the revision that was downloaded first stays.
        known = KNOWN[model].revision if model in KNOWN else ""
        pinned = revision or (known if _IS_COMMIT.fullmatch(known) else next(iter(pins), known or None))
        wanted = {"revision": pinned, "allow_patterns": ["*.json", "*.txt", "*.safetensors"]}
        if download:
            _ask_hub(HfApi(), model, pinned)
        try:
            with loading(name):
                folder = Path(snapshot_download(model, local_files_only=not download, **wanted))
        except PlgsError as error:
            if download:
                raise
            fix = "Add --download to fetch the model from huggingface.co, or name a folder that holds it."
            what = "the model is not on this computer"
            raise PlgsError("not-downloaded", what, name, fix, option="--download") from error
        _check_pin(pin, pins, folder)
    _check_weights(folder)
    return folder


def load_weights(kind: Any, folder: Path, name: str) -> Any:
    """Load network ``name``, in ``folder``, as transformers' class ``kind``, ready to run. Raises PlgsError if bad."""
    limits: dict[str, Any] = {"local_files_only": True, "trust_remote_code": False, "use_safetensors": True}
    with loading(name):
        network, found = kind.from_pretrained(folder, output_loading_info=True, **limits)
    wrong = {key.partition("_")[0]: keys for key, keys in found.items() if keys}
    import torch

    wrong["infinite"] = [key for key, one in network.state_dict().items() if not bool(torch.isfinite(one).all())]
    for trouble, keys in wrong.items():
        if keys:
            what = f"{len(keys)} weights of the model are {trouble}, such as {min(map(str, keys))}"
            raise PlgsError("model-broken", what, name, ANOTHER)
    return network.eval()


def refuse_nan(values: Any, name: str) -> None:
    """Raise PlgsError if the tensor ``values``, an output of the network ``name``, holds NaN."""
    if bool(values.isnan().any()):
        raise PlgsError("model-broken", "the model gives values that are not numbers", name, ANOTHER)


def _refuse_vast(content: object, path: Path, key: str = "") -> None:
    """Raise PlgsError for a number in a model's settings, ``content``, that memory would not suffice for."""
    if isinstance(content, dict | list):
        for inner, each in content.items() if isinstance(content, dict) else ((key, each) for each in content):
            if inner not in _CLASSES:  # class names and their numbers are free
                _refuse_vast(each, path, str(inner))
    elif isinstance(content, int):
        most = _MOST_REPEATS if _REPEATS.search(key) else _MOST_IN[path.name]
        if content > most:
            raise PlgsError("model-vast", f"{key[:40]!r} is {content}, but at most {most} is allowed", path, ANOTHER)


def _check_weights(folder: Path) -> None:
    """Raise PlgsError unless the weights are safetensors in the model's folder, unchanged since their download, and its
    settings have no huge numbers."""
    config, index = folder / "config.json", folder / "model.safetensors.index.json"
    if not config.is_file() or not any(folder.glob("*.safetensors")):
        fix = "Name a folder that transformers' save_pretrained wrote, with config.json and safetensors."
        raise PlgsError("no-model", "there is no model in this folder", folder, fix)
    for path in (folder / name for name in _MOST_IN if (folder / name).exists()):
        _refuse_vast(read_object(path, ANOTHER), path)
    parts = read_object(index, ANOTHER).get("weight_map") if index.exists() else {}
    files = [*parts.values()] if isinstance(parts, dict) else [parts]
    for file in (*files, read_object(config, ANOTHER).get("transformers_weights") or "model.safetensors"):
        if not isinstance(file, str) or not re.fullmatch(r"[\w.-]+\.safetensors", file):
            what = f"{str(file)[:60]!r} is not a safetensors file in the model's folder"
            raise PlgsError("model-outside", what, folder, ANOTHER)
    for path in folder.glob("*.safetensors"):
        digest = path.resolve().name  # the hub's cache links to files that are called by their SHA-256
        if path.is_symlink() and re.fullmatch("[0-9a-f]{64}", digest) and digest_of(path) != digest:
            raise PlgsError("model-broken", "the file was changed", path.resolve(), "Delete it, then download again.")


def _check_pin(pin: Path, pins: Mapping[str, Any], folder: Path) -> None:
    """Record the SHA-256 of a new revision's weights in the file ``pin``, which holds ``pins``. Raises PlgsError if
    recorded ones differ."""
    weights = {path.name: digest_of(path) for path in sorted(folder.glob("*.safetensors"))}
    if (known := pins.get(folder.name)) is None:
        with suppress(OSError):  # a cache that others share may be read-only
            write_atomically(pin, json.dumps({**pins, folder.name: weights}, indent=1) + "\n")
    elif known != weights:
        what = f"the weights of revision {folder.name} are not those that were downloaded first"
        raise PlgsError("model-broken", what, pin, f"Delete {pin.parent}, then fetch the model with --download.")


def _ask_hub(hub: Any, model: str, revision: str | None) -> None:
    """Raise PlgsError if the hub does not answer or lacks this revision; a download would wait for a silent hub."""
    from huggingface_hub.errors import RepositoryNotFoundError, RevisionNotFoundError

    try:
        hub.model_info(model, revision=revision, timeout=_HUB_S)
    except (RepositoryNotFoundError, RevisionNotFoundError) as error:
        what = f"huggingface.co does not offer the model ({type(error).__name__})"
        raise PlgsError("no-model", what, model, "Check the name, or name a folder that holds the model.") from error
    except Exception as error:  # of httpx, or of whatever the hub's library uses in its place
        what = f"huggingface.co does not answer ({type(error).__name__})"
        fix = "Check the connection, or name a folder that holds the model."
        raise PlgsError("hub-silent", what, model, fix) from error
