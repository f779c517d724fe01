"""A synthetic participant as a gymnasium environment, `betaloop/Participant-v0`; importing this module registers it.

Observation: the W newest beta amplitudes in uV, oldest first. Action: the amplitude fraction. Reward: r_k, and r_end added to the last one.
"""

from __future__ import annotations

from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ml.mdp import MdpSettings, end_reward, step_reward
from ml.population.outcomes import GRASP_TEST_STEPS, measure
from ml.population.participants import PARTICIPANTS
from ml.population.sessions import Floats, Simulation
from ml.population.truth import HOURS_OF_A_DAY, VISITS

ENV_ID: Final = "betaloop/Participant-v0"
MAX_BETA_UV: Final = 50.0


class ParticipantEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One participant, one session per episode.

    Args:
        participant: `P1` to `P4`. steps: length of a session. settings: MDP constants, those suggested for the participant by default.
        end_reward: add r_end to the last step's reward.

    Each reset draws a day, an hour and noise from the seed. `info` of the last step has `qoc`.

    Raises:
        ValueError: an unknown participant, or a session too short to measure.
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, participant: str = "P1", steps: int = 300, settings: MdpSettings | None = None, end_reward: bool = True) -> None:
        if participant not in PARTICIPANTS:
            raise ValueError(f"there is no synthetic participant {participant!r}; there are {', '.join(PARTICIPANTS)}")
        if steps < 1:
            raise ValueError(f"a session needs at least one step, not {steps}")
        self.participant = PARTICIPANTS[participant]
        self.steps = steps
        self.settings = self.participant.mdp_settings() if settings is None else settings
        self._with_end = end_reward
        self.observation_space = spaces.Box(0.0, MAX_BETA_UV, (self.settings.window,), np.float32)
        self.action_space = spaces.Box(0.0, 1.0, (1,), np.float32)
        self._simulation: Simulation | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start a session; `options` may fix `hour` (0-6) and `visit`."""
        super().reset(seed=seed)
        chosen = options or {}
        hour = float(chosen.get("hour", self.np_random.uniform(0, HOURS_OF_A_DAY)))
        visit = int(chosen.get("visit", self.np_random.integers(1, VISITS + 1)))
        window = self.settings.window
        self._simulation = Simulation(
            self.participant,
            visits=np.array([visit]),
            hours=np.array([hour]),
            seeds=self.np_random.integers(0, 2**63, 1, dtype=np.uint64),
            study_seeds=self.np_random.integers(1, 2**62, 1),
            periods=window + self.steps,
        )
        lead = [self._simulation.advance(np.ones(1))["beta"][0] for _ in range(window)]
        self._window = np.array(lead)
        self._trace: dict[str, list[float]] = {name: [] for name in ("amplitude", "brady", "tremor", "overload")}
        return self._observation(), {"hour": hour, "visit": visit}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Stimulate for 2 s at the amplitude fraction `action` [1], cut to [0, 1]. The episode ends (terminated) with the session."""
        if self._simulation is None:
            raise RuntimeError("call reset before step")
        amplitude = min(max(float(np.asarray(action).reshape(-1)[0]), 0.0), 1.0)
        done = len(self._trace["amplitude"]) + 1
        out = self._simulation.advance(np.array([amplitude]), moving=done > self.steps - GRASP_TEST_STEPS)
        beta = float(out["beta"][0])
        self._window = np.append(self._window[1:], beta)
        self._trace["amplitude"].append(amplitude)
        for name in ("brady", "tremor", "overload"):
            self._trace[name].append(float(out[name][0]))
        reward = float(step_reward(self.settings, np.array(beta), np.array(amplitude)))
        info: dict[str, Any] = {"beta": beta, "amplitude": amplitude}
        if done == self.steps:
            traces: list[Floats] = [np.array(values) for values in self._trace.values()]
            info["qoc"] = measure(self.participant, self._simulation.counters[0], *traces).qoc
            end = end_reward(self.settings, info["qoc"])
            reward += end if self._with_end and end is not None else 0.0
            self._simulation = None
        return self._observation(), reward, done == self.steps, False, info

    def _observation(self) -> NDArray[np.float32]:
        return np.clip(self._window, 0.0, MAX_BETA_UV).astype(np.float32)


if ENV_ID not in gymnasium.registry:
    gymnasium.register(ENV_ID, entry_point=ParticipantEnv)

__all__ = ["ENV_ID", "ParticipantEnv"]
