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
    hub, text = _hub(), card_of(path) if card is None else Path(card).read_text(encoding="utf-8")
    check_text("repo", repo)
    with _errors_in_one_line(repo):
        api = hub.HfApi(endpoint=_endpoint())
        api.create_repo(repo, private=private, exist_ok=True)
        files = {FILE: Path(path).read_bytes(), CARD: text.encode()}
        operations = [hub.CommitOperationAdd(name, content) for name, content in files.items()]
        done = api.create_commit(repo, operations, commit_message=f"Upload {Path(path).name}")
    return str(done.commit_url)


@typed
def from_hub(repo: str, revision: str | None = None) -> NeuralASM:
    """Return a memory that ``push`` or ``asm-gym push`` has put on the hub; it is downloaded once.

    Args:
        repo: ``owner/name``.
        revision: a commit, a branch or a tag; None for the newest.

    Raises:
        ImportError, ConnectionError: as ``push``.
    """
    hub = _hub()
    with _errors_in_one_line(check_text("repo", repo)):
        path = Path(hub.hf_hub_download(repo, FILE, revision=revision, endpoint=_endpoint()))
    return NeuralASM.load(path)


def card_of(path: str | Path) -> str:
    """Return a card in Markdown from the header of a file."""
    header = read_header(path)
    spec, about = StreamSpec.from_json(header["spec"]), dict(header.get("about", {}))
    rows = [f"| {c.name} | {c.size} | {c.unit} | {c.group} |" for c in spec.channels]
    facts = [f"- {name}: {value}" for name, value in sorted(about.items()) if isinstance(value, str | int | float)]
    lines = [
        "---\nlibrary_name: asm-gym\ntags: [robotics, anomaly-detection]\n---",
        f"# A monitor of {spec.source or 'a stream'} at {1 / spec.dt:g} Hz",
        f"It is of the kind `{header['kind']}`, and alarms above {header['threshold']}.",
        '```python\nfrom asm_gym.monitors.hub import from_hub\n\nasm = from_hub("OWNER/NAME")\n```',
        "\n".join(["| channel | numbers | unit | group |", "|---|---|---|---|", *rows]),
        "\n".join(facts),
    ]
    return "\n\n".join(filter(None, lines)) + "\n"


def _hub() -> Any:
    return require("huggingface_hub", what="the hub")


def _endpoint() -> str | None:
    return os.environ.get("HF_ENDPOINT") or None


@contextmanager
def _errors_in_one_line(repo: str) -> Iterator[None]:
    """Turn what the hub's library raises into one line."""
    try:
        yield
    except Exception as error:
        if type(error).__name__ == "HFValidationError":
            raise ValueError(f"repo must be owner/name, got {repo!r}") from error
        first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise ConnectionError(f"the hub at {_endpoint() or 'huggingface.co'} on {repo}: {first}") from error
