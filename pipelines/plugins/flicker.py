"""An effect: bands of a rolling shutter under lamps that flicker."""
from dataclasses import dataclass
import numpy as np
from sweep.plugins import EffectPlugin, parameter

@dataclass(frozen=True)
class Settings:
    flicker: float = parameter(0.0, "amplitude, relative to light", low=0, high=1, drawable=True)
    flicker_rows: float = parameter(100.0, "rows that a period takes", unit="px", low=1)

def bands(light, patch):
    rows = patch.top + np.arange(len(light))
    wave = np.sin(2 * np.pi * rows / patch.values["flicker_rows"])
    return light * (1 + patch.values["flicker"] * wave)[:, None]

EFFECT = EffectPlugin(apply=bands, settings=Settings, step="light", widens="uneven light")
