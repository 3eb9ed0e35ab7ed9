"""The demonstration with so few episodes that it takes half a minute of a core.

python docs/checks/demo.py FOLDER
"""

from __future__ import annotations

import sys
from pathlib import Path

from rich.console import Console

from asm_gym.scripts.demo import Args, demonstrate


def main(folder: Path) -> None:
    few = {"fit_episodes": 15, "calibration_episodes": 19, "nominal_episodes": 3, "faulty_episodes": 3, "epochs": 13}
    demonstrate(Args(video=False, workers=1, out=folder, **few), Console(width=200))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
