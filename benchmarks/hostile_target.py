"""What is attacked: a decoder, what it may raise, and what its inputs are made of."""

import random
from collections.abc import Callable
from typing import NamedTuple

from benchmarks.hostile_mutation import Mutate, mutate_bytes
from due.errors import DueError


class DecoderTarget(NamedTuple):
    """One decoder."""

    name: str
    decode: Callable[[bytes], object]
    errors: tuple[type[Exception], ...]
    """All that it may raise."""
    seeds: tuple[bytes, ...]
    """Genuine inputs, made by the product's own encoders."""
    mutate: Mutate = mutate_bytes

    def input(self, seed: int, index: int) -> bytes:
        """Input number `index`: the first ones are the genuine ones."""
        if index < len(self.seeds):
            return self.seeds[index]
        chance = random.Random(f"{seed} {self.name} {index}")
        try:
            return self.mutate(chance, self.seeds)
        except (ValueError, DueError, RecursionError):
            return mutate_bytes(chance, self.seeds)  # what was found by coverage need not have a structure

    def attack(self, data: bytes) -> None:
        """Decode; whatever is raised beside the declared errors comes out."""
        try:
            self.decode(data)
        except self.errors:
            return
