"""Memories that come with the package, one for each arm and rate; a file's header says whose body it is."""

from __future__ import annotations

from pathlib import Path

from asm_gym.checkpoint import read_header
from asm_gym.spec import StreamSpec
from asm_gym.stream_view import misfits_of
from asm_gym.validation import check_choice, typed

SHIPPED_FOLDER = Path(__file__).resolve().parent.parent / "pretrained"
"""Their folder.

:meta hide-value:
"""
USUAL_HZ = 20  # rows of a stream a second where each control step has one [Hz]


def pretrained() -> dict[str, Path]:
    """Return the file of each shipped memory, by name."""
    return {path.stem: path for path in sorted(SHIPPED_FOLDER.glob("*.asm"))}


def pretrained_file(name: str) -> Path:
    """Return the file of the memory called ``name``, such as ``"panda"``.

    Raises:
        ValueError: there is none; the message lists those that there are.
    """
    known = pretrained()
    check_choice("pretrained memory", name, known)
    return known[name]


@typed
def pretrained_for(spec: StreamSpec, controller: str) -> str:
    """Return the name of the shipped memory of this body.

    Args:
        spec: of the stream to be watched; its source says whose body it is.
        controller: of the body, by name.

    Raises:
        ValueError: none fits; the message says why each does not, and how to fit one of one's own.
    """
    lines = []
    for name, path in pretrained().items():
        header = read_header(path)
        known = StreamSpec.from_json(header["spec"])
        own_controller = header["about"].get("controller", "")
        misfits = []
        if known.source != spec.source:
            misfits.append(f"robot: {known.source} against {spec.source}")
        if own_controller != controller:
            misfits.append(f"controller: {own_controller} against {controller}")
        misfits += misfits_of(known, spec)
        if not misfits:
            return name
        lines.append(f"  {name}: {'; '.join(misfits)}")
    if spec.source == "spaces":
        raise ValueError(
            "shipped memories know only robosuite's arms in environments of asm_gym: fit a monitor "
            "on healthy episodes of this environment, recorded by StreamRecorder(env), "
            "and pass it as monitor"
        )
    rate = round(1.0 / spec.dt)
    command = f"asm-gym babble --robot {spec.source or 'ROBOT'}"
    if rate != USUAL_HZ:
        command += f" --stream-freq {rate}"
    body = f"{spec.source or 'an unnamed body'} at {1 / spec.dt:g} Hz"
    if controller:
        body += f" under {controller}"
    listed = "\n".join(lines)
    raise ValueError(
        f"no shipped memory fits this stream of {body}. There are:\n{listed}\nFit your own: "
        f"{command} for an arm of robosuite, asm-gym fit DATA for recordings, "
        "and pass it as monitor"
    )
