"""Sessions as trajectories of the MDP, and the replay buffer made of them.

Alignment, everywhere in betaloop: step k = 0, 1, ... is the row t_s = period (k + 1). It holds a_k, the amplitude in force over
(period k, period (k + 1)], and the beta amplitude of that same window. The state s_k is the W beta amplitudes *before* that row,
oldest first; r_k uses the row itself. Source: Gao et al. 2023, section 4.1.

A window may contain a stated number of imputed beta amplitudes. An imputed value is between the session's mean and the line from the
measured value before to the one after. Its place depends on how far the session's beta carries over from row to row. They are marked, never
a window's newest value, and never used for a reward.
"""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ml.arrow import to_arrow, to_numpy
from ml.designs import Hold
from ml.mdp import AMPLITUDE_TOLERANCE, MdpSettings, end_reward, step_reward
from ml.qoc import Qoc, failed_qoc

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


PRIOR_PAIRS = 10
"""Pairs of unrelated rows that are added to the measured ones where autocorrelations are estimated: short sessions inform little about
them."""


def _carried_over(deviations: Floats) -> float:
    """Estimate the weight of the mean of both neighbours in the best linear prediction of a value between them, 0 to 1.

    2 r_1 / (1 + r_2) with the autocorrelations at one and two rows: cov(d_t, m) / var(m) for m = (d_{t-1} + d_{t+1}) / 2. For longer gaps
    it is an approximation.

    Args:
        deviations: of beta from the session's mean, [n]; NaN where not measured.
    """
    variance = float(np.nanmean(deviations**2))
    if variance == 0:
        return 0.0

    def correlation(lag: int) -> float:
        products = deviations[lag:] * deviations[:-lag]
        measured = products[np.isfinite(products)]
        return float(measured.sum()) / (variance * (measured.size + PRIOR_PAIRS))

    return float(np.clip(2 * correlation(1) / max(1 + correlation(2), 0.1), 0.0, 1.0))


@dataclass(frozen=True)
class SessionTrajectory:
    """One session: W beta amplitudes before it, then T steps.

    Attributes:
        session_id: the session's number in the study store.
        visit: number of the visit.
        controller: `cdbs`, `rl`, `distilled`, `no_dbs`, `random` or `other`.
        policy_id: the policy that ran, where one did.
        lead_beta: beta amplitudes before step 0, shape [W], oldest first; NaN where none is valid.
        beta: beta amplitude of each step's row, shape [T]; NaN where invalid.
        amplitude: amplitude fraction a_k, shape [T]; NaN where unknown. May exceed 1: such a step is not usable.
        qoc: end-of-session QoCs.
        random_bound: B in force for a random session; else None.
        holds: decisions of a random session with sustained draws, in order and without gaps up to where it ended. Empty where every step is
            a decision of its own: a random session's density is then 1 / (1 - B) on [B, 1] at every step.
        lead_amplitude: amplitude fraction in force just before step 0, where it is known; else None.
        stopped_as: the QoCs that a session counts as which ended for the participant's sake (they asked for it, an adverse event): it is a
            failure of what ran (`ml.qoc.failed_qoc` of the participant's sessions). None of any other session.
        most_imputed: how many imputed beta amplitudes a window may hold.
        medication_h: hours from the last dose to the session's start, where they are known; else None.

    Raises:
        ValueError: arrays of unequal length, a session without a step, or as many imputed values as the window has. Also holds that omit
            steps or go beyond the session.
    """

    session_id: int
    visit: int
    controller: str
    lead_beta: Floats
    beta: Floats
    amplitude: Floats
    qoc: Qoc = field(default_factory=Qoc)
    policy_id: int | None = None
    random_bound: float | None = None
    lead_amplitude: float | None = None
    stopped_as: Qoc | None = None
    most_imputed: int = 0
    holds: tuple[Hold, ...] = ()
    medication_h: float | None = None

    def __post_init__(self) -> None:
        if self.beta.shape != self.amplitude.shape or self.beta.ndim != 1:
            raise ValueError(f"session {self.session_id}: {self.beta.shape} beta rows against {self.amplitude.shape} amplitudes")
        if self.beta.size == 0:
            raise ValueError(f"session {self.session_id} has no step")
        if not 0 <= self.most_imputed < max(1, self.lead_beta.size):
            raise ValueError(f"session {self.session_id}: {self.most_imputed} imputed values of {self.lead_beta.size} in a window")
        ends = [0, *(h.start + h.steps for h in self.holds)]
        if any(h.start != end or h.steps < 1 for h, end in zip(self.holds, ends, strict=False)) or ends[-1] > self.steps:
            raise ValueError(f"session {self.session_id}: its holds leave out steps or go beyond its {self.steps} steps")

    @property
    def steps(self) -> int:
        """T, number of steps."""
        return int(self.beta.size)

    @property
    def uniform_bound(self) -> float | None:
        """B where every step's amplitude was a new draw, uniform on [B, 1]; None for any other session."""
        return None if self.holds else self.random_bound

    @property
    def measured_beta(self) -> Floats:
        """Lead and session in one array as measured, shape [W + T]; NaN where invalid."""
        return np.concatenate([self.lead_beta, self.beta])

    @property
    def padded_beta(self) -> Floats:
        """Lead and session, with imputed values in gaps of up to `most_imputed`, shape [W + T]; s_k is `padded_beta[k : k + W]`."""
        return self._fill_gaps()[0]

    @property
    def imputed(self) -> Mask:
        """Imputed elements of `padded_beta` as a mask, shape [W + T]."""
        return self._fill_gaps()[1]

    def _fill_gaps(self) -> tuple[Floats, Mask]:
        beta = self.measured_beta
        known = np.flatnonzero(~np.isnan(beta))
        imputed = np.zeros(beta.size, dtype=bool)
        if self.most_imputed == 0 or known.size < 2:
            return beta, imputed
        missing = np.flatnonzero(np.isnan(beta))
        after = np.searchsorted(known, missing)
        inside = (after > 0) & (after < known.size)
        gap = known[np.minimum(after, known.size - 1)] - known[np.maximum(after - 1, 0)] - 1
        imputed[missing[inside & (gap <= self.most_imputed)]] = True
        level = float(beta[known].mean())
        line = np.interp(np.flatnonzero(imputed), known, beta[known])
        beta[imputed] = level + self.carried_over * (line - level)
        return beta, imputed

    @property
    def carried_over(self) -> float:
        """Weight, 0 to 1, of the line between both neighbours in an imputed value; the rest is the session's mean."""
        beta = self.measured_beta
        return 0.0 if np.isnan(beta).all() else _carried_over(beta - float(np.nanmean(beta)))

    def states(self) -> Floats:
        """Return s_0 ... s_T, shape [T + 1, W], oldest beta first; NaN where a window has an invalid beta that may not be imputed in it."""
        filled, imputed = self._fill_gaps()
        window = self.lead_beta.size
        states = sliding_window_view(filled, window)
        if not imputed.any():
            return states
        marks = sliding_window_view(imputed, window)
        refused: Mask = np.logical_or(marks[:, -1], marks.sum(axis=1) > self.most_imputed)
        return np.where(refused[:, None], sliding_window_view(self.measured_beta, window), states)

    def usable(self) -> Mask:
        """Mark steps that may enter a buffer, shape [T]: state, next state and amplitude are known, beta is measured and 0 <= a <= 1."""
        whole = np.asarray(np.isfinite(self.states()).all(axis=1))
        amplitude_ok = (self.amplitude >= -AMPLITUDE_TOLERANCE) & (self.amplitude <= 1 + AMPLITUDE_TOLERANCE)
        return whole[:-1] & whole[1:] & amplitude_ok

    def from_first_window(self) -> SessionTrajectory:
        """Cut the steps before the first whole state off where beta begins less than W steps before the session; else return it as it is.

        None of those steps is usable. `lead_amplitude` stays, as its effect lasts minutes. Of an amplitude that lasts across the cut
        the rest stays, which was drawn like the whole.
        """
        known, window = np.flatnonzero(~np.isnan(self.measured_beta)), self.lead_beta.size
        k = int(known[0]) if known.size else 0
        if not 0 < k <= window or k >= self.steps or not np.isfinite(self.states()[k]).all():
            return self
        holds = tuple(
            replace(h, start=max(h.start - k, 0), steps=h.steps - max(k - h.start, 0)) for h in self.holds if h.start + h.steps > k
        )
        lead, beta, amplitude = self.measured_beta[k : k + window], self.beta[k:], self.amplitude[k:]
        return replace(self, lead_beta=lead, beta=beta, amplitude=amplitude, holds=holds)

    def rewards(self, settings: MdpSettings) -> Floats:
        """Compute r_k, shape [T]; NaN where beta or amplitude is unknown."""
        return step_reward(settings, self.beta, self.amplitude)

    @property
    def stopped(self) -> bool:
        """True where the session ended for the participant's sake."""
        return self.stopped_as is not None

    @property
    def counted_qoc(self) -> Qoc:
        """The QoCs that count: `stopped_as` of a stopped session, whatever was measured, else as measured.

        A stopped cDBS session counts as measured, so that its failure does not help the policies that are compared with it.
        """
        return self.stopped_as if self.stopped_as is not None and self.controller != "cdbs" else self.qoc

    def end_reward(self, settings: MdpSettings) -> float | None:
        """Compute r_end of the QoCs that count, or None where one it needs is missing."""
        return end_reward(settings, self.counted_qoc)


@dataclass(frozen=True)
class Transitions:
    """Usable steps of a buffer in one table; row order is session, then step.

    Attributes:
        states: s_k, [N, W]. actions: a_k, [N], within [0, 1]. rewards: r_k, [N]. next_states: s_{k+1}, [N, W].
        session: index into `ReplayBuffer.sessions`, [N]. step: k, [N].
    """

    states: Floats
    actions: Floats
    rewards: Floats
    next_states: Floats
    session: NDArray[np.int64]
    step: NDArray[np.int64]


@dataclass(frozen=True)
class ReplayBuffer:
    """All sessions of one participant that a learner or an estimator may see, in one unit of beta from one source.

    Attributes:
        settings: MDP constants.
        sessions: trajectories, ordered by visit and session id.
        beta_unit: unit of every beta amplitude in it (`mV`, `uV`, `device units`, ...).
        beta_source: where beta comes from (`time_domain`, `device_power`, `percept_lfp`, `table`).
    """

    settings: MdpSettings
    sessions: tuple[SessionTrajectory, ...]
    beta_unit: str
    beta_source: str

    def __post_init__(self) -> None:
        if not self.sessions:
            raise ValueError("a replay buffer needs at least one session")
        for session in self.sessions:
            if session.lead_beta.size != self.settings.window:
                raise ValueError(
                    f"session {session.session_id} has {session.lead_beta.size} beta amplitudes before its first step; "
                    f"the window is {self.settings.window}"
                )

    def transitions(self) -> Transitions:
        """Collect all usable steps. Raises ValueError when there is none."""
        states, actions, rewards, next_states, index, step = [], [], [], [], [], []
        for i, session in enumerate(self.sessions):
            k = np.flatnonzero(session.usable())
            windows = session.states()
            states.append(windows[k])
            next_states.append(windows[k + 1])
            actions.append(np.clip(session.amplitude[k], 0.0, 1.0))
            rewards.append(session.rewards(self.settings)[k])
            index.append(np.full(k.size, i))
            step.append(k)
        if sum(part.size for part in step) == 0:
            raise ValueError("no usable step in the buffer: every step lacks a valid beta window or an amplitude within 0-1")
        return Transitions(
            np.concatenate(states),
            np.concatenate(actions),
            np.concatenate(rewards),
            np.concatenate(next_states),
            np.concatenate(index),
            np.concatenate(step),
        )

    def beta_scale(self) -> tuple[float, float]:
        """Compute mean and standard deviation of all valid beta amplitudes, for normalising network inputs."""
        values = np.concatenate([s.measured_beta for s in self.sessions])
        values = values[~np.isnan(values)]
        std = float(values.std())
        return float(values.mean()), std if std > 0 else 1.0

    def median_steps(self) -> int:
        """Compute the median session length in steps: the default horizon H of returns."""
        return int(np.median([s.steps for s in self.sessions]))


_SCHEMA_VERSION = 1
_IMPUTED_SCHEMA_VERSION = 2
"""Of buffers whose windows may hold imputed values, which a reader of version 1 would not find. Values are stored as measured."""
_HELD_SCHEMA_VERSION = 3
"""Version of buffers with sustained draws, whose steps a reader of version 2 would take for decisions of their own."""
_STOPPED_SCHEMA_VERSION = 5
"""Version of buffers with stopped sessions, which a reader of version 3 would take as measured. Version 4 lacks what they count as."""


def _schema_version(buffer: ReplayBuffer) -> int:
    """Choose the lowest version that can express all of a buffer, so that older buffers keep their bytes and their names."""
    if any(s.stopped for s in buffer.sessions):
        return _STOPPED_SCHEMA_VERSION
    if any(s.holds for s in buffer.sessions):
        return _HELD_SCHEMA_VERSION
    return _IMPUTED_SCHEMA_VERSION if any(s.most_imputed for s in buffer.sessions) else _SCHEMA_VERSION


def to_parquet(buffer: ReplayBuffer) -> bytes:
    """Write the buffer as Parquet bytes: one row per beta amplitude (step < 0: the window before the session), constants in the metadata.

    The bytes depend on the buffer alone (and the pyarrow version), so that their SHA-256 names it.
    """
    import pyarrow as pa  # 28 MB, which a process that reads no snapshot does without
    import pyarrow.parquet as pq

    columns: dict[str, list[NDArray[Any]]] = {"session_id": [], "step": [], "beta": [], "amplitude": []}
    for s in buffer.sessions:
        lead = s.lead_beta.size
        columns["session_id"].append(np.full(lead + s.steps, s.session_id, dtype=np.int64))
        columns["step"].append(np.arange(-lead, s.steps, dtype=np.int32))
        columns["beta"].append(s.measured_beta)
        columns["amplitude"].append(np.concatenate([np.full(lead, np.nan), s.amplitude]))
    meta = {
        "schema_version": _schema_version(buffer),
        "settings": buffer.settings.to_json(),
        "beta_unit": buffer.beta_unit,
        "beta_source": buffer.beta_source,
        "sessions": [_session_meta(s) for s in buffer.sessions],
    }
    table = pa.table({name: to_arrow(np.concatenate(parts)) for name, parts in columns.items()})
    table = table.replace_schema_metadata({"betaloop": json.dumps(meta, sort_keys=True)})
    sink = io.BytesIO()
    pq.write_table(table, sink, compression="zstd")
    return sink.getvalue()


def from_parquet(content: bytes) -> ReplayBuffer:
    """Read what `to_parquet` wrote. Raises ValueError when the bytes are not such a buffer."""
    import pyarrow.parquet as pq

    table = pq.ParquetFile(io.BytesIO(content)).read()
    raw = (table.schema.metadata or {}).get(b"betaloop")
    if raw is None:
        raise ValueError("this Parquet file is not a betaloop buffer snapshot: its metadata lack the key 'betaloop'")
    meta = json.loads(raw)
    if not _SCHEMA_VERSION <= meta["schema_version"] <= _STOPPED_SCHEMA_VERSION:
        raise ValueError(
            f"buffer snapshot of schema version {meta['schema_version']}; "
            f"this betaloop reads {_SCHEMA_VERSION} to {_STOPPED_SCHEMA_VERSION}"
        )
    ids, step, beta, amplitude = (to_numpy(table[name]) for name in ("session_id", "step", "beta", "amplitude"))
    sessions = []
    failed = failed_qoc(Qoc(**m["qoc"]) for m in meta["sessions"])  # of version 4, which says of a session only that it was stopped
    for m in meta["sessions"]:
        own = ids == m["session_id"]
        lead, body = own & (step < 0), own & (step >= 0)
        sessions.append(
            SessionTrajectory(
                session_id=m["session_id"],
                visit=m["visit"],
                controller=m["controller"],
                policy_id=m["policy_id"],
                lead_beta=beta[lead],
                beta=beta[body],
                amplitude=amplitude[body],
                qoc=Qoc(**m["qoc"]),
                random_bound=m["random_lower_bound"],
                lead_amplitude=m.get("lead_amplitude"),
                stopped_as=Qoc(**m["stopped_as"]) if "stopped_as" in m else failed if m.get("stopped") else None,
                most_imputed=m.get("most_imputed", 0),
                holds=tuple(Hold(*h) for h in m.get("holds", ())),
                medication_h=m.get("medication_h"),
            )
        )
    return ReplayBuffer(MdpSettings(**meta["settings"]), tuple(sessions), meta["beta_unit"], meta["beta_source"])


def content_hash(content: bytes) -> str:
    """Compute the SHA-256 of stored bytes, in hex."""
    return hashlib.sha256(content).hexdigest()


def _session_meta(s: SessionTrajectory) -> dict[str, Any]:
    # members that are omitted at their default, so that the bytes of older buffers stay what they were
    later: dict[str, Any] = {"most_imputed": s.most_imputed} if s.most_imputed else {}
    later |= {"lead_amplitude": s.lead_amplitude} if s.lead_amplitude is not None else {}
    later |= {"holds": [[h.start, h.steps, h.log_density] for h in s.holds]} if s.holds else {}
    later |= {"stopped_as": asdict(s.stopped_as)} if s.stopped_as is not None else {}
    later |= {"medication_h": s.medication_h} if s.medication_h is not None else {}
    return later | {
        "session_id": s.session_id,
        "visit": s.visit,
        "controller": s.controller,
        "policy_id": s.policy_id,
        "random_lower_bound": s.random_bound,
        "qoc": asdict(s.qoc),
    }
