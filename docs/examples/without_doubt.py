"""A memory that believes all its predictions alike, to see what doubt brings.

PYTHONPATH=. asm-gym evaluate --monitors neural_asm docs.examples.without_doubt:WithoutDoubt
"""

from unittest.mock import patch

from asm_gym import NeuralASM
from asm_gym.memory import association_learning


class WithoutDoubt(NeuralASM):
    """A Neural ASM whose errors are not divided by how far its inputs are from those that it learned."""

    kind = "without_doubt"

    def fit(self, *arguments, **options):
        with patch.object(association_learning, "DOUBTS", (0.0,)):
            return super().fit(*arguments, **options)
