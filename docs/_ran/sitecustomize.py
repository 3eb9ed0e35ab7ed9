"""Notes which files of the repository Python runs or reads, in the file that ``PAGES_RAN`` names, one a line.

Python imports a ``sitecustomize`` by itself as it starts, in worker processes too, where this folder is on the path.
Every module is run by ``exec``, which is audited, and so is every ``open``: a process that is killed has noted all the
same.
"""

from __future__ import annotations

import os
import sys
from typing import Any


def _watch(notes: str, root: str) -> None:
    seen = {notes}

    def note(event: str, args: tuple[Any, ...]) -> None:
        if event == "exec":
            name = getattr(args[0], "co_filename", None)
        elif event == "open" and isinstance(args[0], str) and isinstance(args[1], str) and "r" in args[1]:
            # Sources are read to stamp caches too, and bytecode instead of them: what was run says `exec`.
            name = None if args[0].endswith((".py", ".pyc")) else args[0]
        else:
            return
        if not name or name in seen:
            return
        seen.add(name)
        path = os.path.abspath(name)
        if path.startswith(root):
            # Opened anew for each file, once: a descriptor that is kept may be another file's in a forked process.
            out = os.open(notes, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            os.write(out, f"{path}\n".encode())
            os.close(out)

    sys.addaudithook(note)


if "PAGES_RAN" in os.environ:
    _watch(
        os.environ["PAGES_RAN"], os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))) + os.sep
    )
