"""The check of what was not needed: the rule of stopping is applied to the stored results again."""

from __future__ import annotations

from collections.abc import Container, Iterator

import numpy as np

from sweep.errors import PipelineError, StoreError
from sweep.integrity.damage import BlockDamage, Damage
from sweep.plan.stopping import StoppingRule
from sweep.sampling.deciding import Decider, Decision, scenes_needed
from sweep.store.run_store import RunStore


class NeededCheck:
    """Finds blocks whose scenes were needed, or not, against the rule of their pipeline."""

    def __init__(self, store: RunStore) -> None:
        self._store = store

    def run(self, sound: Container[int]) -> Iterator[Damage]:
        """Yield the damage of blocks; a group is followed as far as its blocks are sound."""
        rule = self._store.pipeline.stopping
        if rule is None:
            return
        try:
            decider = Decider.of(self._store, rule)
        except (PipelineError, ValueError) as error:
            yield BlockDamage(0, str(self._store.blocks[0]), f"no rule of stopping: {error}")
            return
        waves = decider.waves
        for group in range(waves.groups):
            for wave in range(len(waves.ends)):
                numbers = list(waves.numbers(group, wave))
                if not all(number in sound for number in numbers):
                    break
                if (damage := list(self._of_wave(decider, rule, numbers, wave))):
                    yield from damage
                    break

    def _of_wave(
        self, decider: Decider, rule: StoppingRule, numbers: list[int], wave: int
    ) -> Iterator[Damage]:
        # Bases only have to differ from wave to wave here: one process reads a store as it is.
        decision = Decision(rule, wave, tuple(range(wave)))
        for number in numbers:
            block = self._store.blocks[number]
            stored = scenes_needed(self._store, block)
            try:
                needed = decider.needed(block, decision) if wave else np.ones_like(stored)
            except StoreError as error:
                yield BlockDamage(number, str(block), str(error))
                return
            if (wrong := int((stored != needed).sum())):
                yield BlockDamage(
                    number, str(block),
                    f"{wrong:,} scenes are not flagged as the results of earlier trials demand",
                )
