"""Memories on the Hugging Face hub: a file of arrays and JSON, and its card. Nothing is fetched unless it is asked for.

``HF_ENDPOINT`` names another server of the same API, and ``hf auth login`` or ``HF_TOKEN`` says who you are.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from asm_gym.checkpoint import read_header
from asm_gym.extras import require
from asm_gym.monitors.neural_asm import NeuralASM
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_text, typed

FILE, CARD = "memory.asm", "README.md"
"""Files in a repository of a memory."""


@typed
def push(path: str | Path, repo: str, card: str | Path | None = None, private: bool = False) -> str:
    """Upload a memory and its card to the hub, and return their address.

    Args:
        path: of a file that ``save`` wrote.
        repo: ``owner/name``; it is made where there is none.
        card: Markdown that says what it was learned from and how well it judges; where None, what the file says.
        private: of a repository that is made.

    Raises:
        ImportError: huggingface_hub is not installed.
        ValueError: the file is no monitor; the repository's name is none.
        ConnectionError: the hub cannot be reached, or refuses; the message has its answer.
    """
    text = _card(path) if card is None else Path(card).read_text(encoding="utf-8")
    with _hub(repo) as hub:
        api = hub.HfApi(endpoint=_endpoint())
        api.create_repo(repo, private=private, exist_ok=True)
        files = {FILE: Path(path).read_bytes(), CARD: text.encode()}
        operations = [hub.CommitOperationAdd(name, content) for name, content in files.items()]
        return str(api.create_commit(repo, operations, commit_message=f"Upload {Path(path).name}").commit_url)


@typed
def from_hub(repo: str, revision: str | None = None) -> NeuralASM:
    """Return a memory that ``push`` has put on the hub; it is downloaded once.

    Args:
        repo: ``owner/name``.
        revision: a commit, a branch or a tag; None for the newest.

    Raises:
        ImportError, ConnectionError: as ``push``.
    """
    with _hub(repo) as hub:
        path = hub.hf_hub_download(repo, FILE, revision=revision, endpoint=_endpoint())
    return NeuralASM.load(Path(path))


def _card(path: str | Path) -> str:
    """Return a card in Markdown from the header of a file."""
    header = read_header(path)
    spec, about = StreamSpec.from_json(header["spec"]), header.get("about", {})
    facts = {"kind": header["kind"], "threshold": header["threshold"], "channels": ", ".join(spec.slices), **about}
    lines = [
        "---\nlibrary_name: asm-gym\ntags: [robotics, anomaly-detection]\n---\n",
        f"# A monitor of {spec.source or 'a stream'} at {1 / spec.dt:g} Hz\n",
        'Load it by `asm_gym.monitors.hub.from_hub("OWNER/NAME")`.\n',
        *(f"- {name}: {value}" for name, value in facts.items() if isinstance(value, str | int | float)),
    ]
    return "\n".join(lines) + "\n"


def _endpoint() -> str | None:
    return os.environ.get("HF_ENDPOINT") or None


@contextmanager
def _hub(repo: str) -> Iterator[Any]:
    """Give the hub's library, whose errors become one line."""
    hub = require("huggingface_hub", what="the hub")
    check_text("repo", repo)
    try:
        yield hub
    except Exception as error:
        if type(error).__name__ == "HFValidationError":
            raise ValueError(f"repo must be owner/name, got {repo!r}") from error
        first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise ConnectionError(f"the hub at {_endpoint() or 'huggingface.co'} on {repo}: {first}") from error
