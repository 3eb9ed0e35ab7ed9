"""Drift that is reached before the memory and the guard notice, for one episode of each way to forge the senses.

python docs/checks/attack.py
"""

from __future__ import annotations

from asm_gym.scripts.reproduce.attack import ALL, BOTH, POSITION, Attack, Config, attacked

ATTACKS = {
    "encoder alone": Attack(POSITION, 2, 0.1),
    "encoder and speed": Attack(BOTH, 1, 0.1),
    "encoder, speed and hand": Attack(ALL, 2, 0.1),
    "encoder alone, after a knock": Attack(POSITION, 2, 0.1, knock=True),
    "means": Attack("means"),
}


def main() -> None:
    for name, attack in ATTACKS.items():
        said = attacked((attack, 2000), Config(task="Lift"))
        what, unit = ("drift", "rad") if attack.joint >= 0 else ("seconds", "s")
        found = [who for who in ("memory", "guard") if said[f"found_by_{who}"]]
        reached = (f"{who} {said[f'{what}_{who}']:.3f} {unit}" for who in found)
        print(f"{name}: {', '.join(reached) or 'never'}")


if __name__ == "__main__":
    main()
