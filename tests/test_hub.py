"""Memories go to a server of the hub's API and come back the same; nothing is asked of it unless it is asked for."""

from __future__ import annotations

import base64
import hashlib
import json
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec

import numpy as np
import pytest

from asm_gym import NeuralASM
from asm_gym.monitors.shipped import CARD, FILE, from_hub
from asm_gym.scripts.cli import main
from tests.streams import sine_episodes

needs_hub = pytest.mark.skipif(not find_spec("huggingface_hub"), reason="pip install 'asm-gym[hub]'")
COMMIT = "0123456789abcdef0123456789abcdef01234567"


class Hub(BaseHTTPRequestHandler):
    """As much of the hub's API as a commit of small files and a download take."""

    files: dict[str, bytes] = {}  # noqa: RUF012
    asked: list[str] = []  # noqa: RUF012

    def log_message(self, *args):
        pass

    def answer(self, body=b"", kind="application/json", status=200, **headers):
        body = json.dumps(body).encode() if not isinstance(body, bytes) else body
        self.send_response(status)
        for name, value in {"Content-Type": kind, "Content-Length": len(body), **headers}.items():
            self.send_header(name.replace("_", "-"), str(value))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_POST(self):
        self.asked.append(self.path)
        said = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if self.path.endswith("/repos/create"):
            self.answer({"url": f"http://{self.headers['Host']}/me/panda", "id": "me/panda", "name": "me/panda"})
        elif self.path == "/api/validate-yaml":
            self.answer({"errors": [], "warnings": []})
        elif "/preupload/" in self.path:
            how = {"uploadMode": "regular", "shouldIgnore": False}
            named = [{"path": f["path"]} | how for f in json.loads(said)["files"]]
            self.answer({"files": named})
        elif "/commit/" in self.path:
            for line in map(json.loads, said.splitlines()):
                if line["key"] == "file":
                    self.files[line["value"]["path"]] = base64.b64decode(line["value"]["content"])
            url = f"http://{self.headers['Host']}/me/panda/commit/{COMMIT}"
            self.answer({"commitUrl": url, "commitOid": COMMIT, "pullRequestUrl": None})
        else:
            self.answer({"error": "no such place"}, status=404)

    def do_GET(self):
        self.asked.append(self.path)
        name = self.path.rpartition("/")[2]
        if "/resolve/" in self.path and name in self.files:
            tag = '"' + hashlib.sha1(self.files[name]).hexdigest() + '"'
            self.answer(self.files[name], "application/octet-stream", ETag=tag, X_Repo_Commit=COMMIT)
        else:
            self.answer({"error": "Repository not found"}, status=404, X_Error_Code="RepoNotFound")

    do_HEAD = do_GET  # noqa: N815


@pytest.fixture
def server(monkeypatch, tmp_path):
    Hub.files, Hub.asked = {}, []
    server = ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{server.server_port}")
    monkeypatch.setenv("HF_TOKEN", "hf_nobody")
    monkeypatch.setenv("HF_HUB_DISABLE_XET", "1")
    hub = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setattr(hub, "HF_HUB_CACHE", str(tmp_path / "cache"))
    yield Hub
    server.shutdown()
    server.server_close()


@pytest.fixture
def memory(tmp_path):
    episodes = sine_episodes(30)
    asm = NeuralASM(episodes[0].spec, hidden_size=8, association_size=8, epochs=1).fit(episodes[:10])
    asm.calibrate(episodes[10:], false_alarm_rate=0.1).save(tmp_path / "small.asm")
    return asm, tmp_path / "small.asm"


@needs_hub
def test_a_memory_that_was_pushed_comes_back_the_same_with_its_card(server, memory, capsys):
    asm, path = memory
    assert main(["push", str(path), "me/panda"]) == 0
    assert f"/me/panda/commit/{COMMIT}" in capsys.readouterr().out
    assert server.files[FILE] == path.read_bytes()
    assert "- channels: joint_position, command" in server.files[CARD].decode()
    back = from_hub("me/panda")
    episode = sine_episodes(1)[0]
    np.testing.assert_array_equal(back.score(episode).value, asm.score(episode).value)


@needs_hub
def test_what_the_hub_refuses_is_one_line(server, memory, capsys):
    assert main(["push", str(memory[1]), "me/no/such thing"]) == 2
    assert main(["push", "no.asm", "me/panda"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2


def test_without_its_library_the_hub_names_the_extra(memory, monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ImportError, match="huggingface_hub"):
        from_hub("me/panda")
