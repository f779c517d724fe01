"""The lines between a runner and a device: beta amplitudes in, amplitudes out. One message per line, ASCII, words separated by spaces.

From the device side:

    hello 1 PARTICIPANT SIDE UNIT SOURCE PERIOD_MS   once, first: who and what is connected; SIDE is left, right or -
    beta SEQ T_MS VALUE UNIT SOURCE                  every period: SEQ counts up by 1, T_MS is the sender's own monotonic clock at the end
                                                     of the period, VALUE a number, or nan where there is none
    stop                                             end the session now

From the runner:

    controller 1 PARTICIPANT SIDE PERIOD_MS CDBS_MA MIN_MA MAX_MA WATCHDOG
    amplitude SEQ T_MS MA policy|cdbs REASONS        every period; SEQ counts up by 1, T_MS is the runner's monotonic clock, REASONS are
                                                     separated by commas, - where there are none
    end SEQ T_MS CDBS_MA HOW                         the session is over: clinical settings
    refused CODE                                     nothing will run: clinical settings

The watchdog: a device side expects whole messages, each a PERIOD_MS after the one before. Without WATCHDOG of them in a row it returns to
clinical settings on its own, and stays there until a new session. A line without its end is no message.
"""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from .envelope import BetaSample, Decision, EnvelopeLimits, Signal, reason_names

VERSION = 1
WATCHDOG = 2
"""Missing messages after which a device side returns to clinical settings."""
LATEST = 0.5
"""A message may come this share of a period late before the device side counts it as missing."""
LONGEST_LINE = 200
"""Characters of a line; a longer one is no message."""
JUMP = 0.5
"""The sender's clock and ours may differ by this share of a period from one beta amplitude to the next; beyond, its clock was changed."""
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_WHOLE = re.compile(r"[0-9]{1,15}")


def number(text: str) -> float:
    """Parse a decimal number, NaN for any other text: float() alone takes "1_5" for 15."""
    return float(text) if _NUMBER.fullmatch(text) else math.nan


class Peer(NamedTuple):
    """Identity that a device side must have: the bundle's participant, side (None: not stated), signal and period."""

    participant: str
    side: str | None
    signal: Signal
    period_s: float


class Taken(NamedTuple):
    """Result of a line.

    Attributes:
        sample: a beta amplitude, at the time of the runner's clock at which its period ended; NaN for a value that is no number.
        fault: what is wrong with the link, in words for the log; "" where nothing is.
        stop: whether the device asks for the end. stranger: what differs, where the device is another one than the bundle is for.
    """

    sample: BetaSample | None = None
    fault: str = ""
    stop: bool = False
    stranger: str = ""


class Reader:
    """Lines of a device side, judged as they come: numbers that repeat or skip, clocks that jump, another participant, side or unit.

    Args:
        peer: who must be connected.
        bare: whether a line may be a lone number, of the bundle's signal and without number and clock: on the bench alone.
    """

    def __init__(self, peer: Peer, bare: bool = False) -> None:
        self._peer, self._bare = peer, bare
        self._greeted = bare
        self._seq: int | None = None
        self._sent_s = self._arrived_s = 0.0
        self._offset_s = math.inf

    def restart(self) -> None:
        """Restart after a lost link: a new one begins with its own hello, numbers and clock."""
        self._greeted, self._seq, self._offset_s = self._bare, None, math.inf

    def take(self, line: str, arrived_s: float) -> Taken:
        """Judge a line that arrived at a time of the runner's clock."""
        words = line.split()
        if len(line) > LONGEST_LINE or not line.isascii():
            return self._fault("a line that is no message")
        if words == ["stop"]:
            return Taken(stop=True)
        if words[:1] == ["hello"]:
            return self._hello(words)
        if not self._greeted:
            return Taken(fault="a line before the device said who it is") if words else Taken()
        if words[:1] == ["beta"] and len(words) == 6 and _WHOLE.fullmatch(words[1]) and math.isfinite(number(words[2])):
            return self._beta(int(words[1]), number(words[2]) / 1000.0, number(words[3]), Signal(words[4], words[5]), arrived_s)
        if self._bare:
            return Taken(BetaSample(arrived_s, number(words[0]) if len(words) == 1 else math.nan, self._peer.signal)) if words else Taken()
        return self._fault("a line that is no message") if words else Taken()

    def _hello(self, words: list[str]) -> Taken:
        mine = self._peer
        if len(words) != 7:
            return self._fault("a hello that is not whole")
        said = {"protocol": words[1], "participant": words[2], "side": words[3], "unit": words[4], "source": words[5], "period": words[6]}
        wanted = {
            "protocol": str(VERSION),
            "participant": mine.participant,
            "side": mine.side or "-",
            "unit": mine.signal.unit.replace(" ", "_"),
            "source": mine.signal.source,
            "period": f"{1000 * mine.period_s:g}",
        }
        differs = [f"{name} {said[name]} instead of {wanted[name]}" for name in said if said[name] != wanted[name]]
        if differs:
            return Taken(stranger=", ".join(differs))
        again = self._greeted and self._seq is not None
        self.restart()
        self._greeted = True
        return Taken(fault="the device started anew") if again else Taken()

    def _beta(self, seq: int, sent_s: float, value: float, signal: Signal, arrived_s: float) -> Taken:
        before, self._seq = self._seq, seq
        signal = self._peer.signal if signal == (self._peer.signal.unit.replace(" ", "_"), self._peer.signal.source) else signal
        fault = ""
        if before is not None and not self._follows(seq - before, sent_s):
            fault = f"number {seq} after number {before}"
        elif before is not None and abs((sent_s - self._sent_s) - (arrived_s - self._arrived_s)) > JUMP * self._peer.period_s:
            # a burst of delayed lines differs too: by the delay of its first line, which the oldest offset shows
            ahead = sent_s + self._offset_s - arrived_s
            if ahead > JUMP * self._peer.period_s or sent_s <= self._sent_s:
                fault = "the device's clock jumped"
        if fault:
            self._offset_s = math.inf
        self._sent_s, self._arrived_s = sent_s, arrived_s
        self._offset_s = min(self._offset_s, arrived_s - sent_s)
        return Taken(BetaSample(min(sent_s + self._offset_s, arrived_s), value, signal), fault)

    def _follows(self, steps: int, sent_s: float) -> bool:
        """Decide whether a number is so many after the last one; numbers between were lost where the sender's clock went on with them."""
        period_s = self._peer.period_s
        return steps == 1 or (steps > 1 and abs(sent_s - self._sent_s - steps * period_s) <= JUMP * period_s)

    def _fault(self, what: str) -> Taken:
        self._offset_s = math.inf
        return Taken(fault=what)


def greeting(peer: Peer, limits: EnvelopeLimits) -> str:
    """Write the runner's first line."""
    side = peer.side or "-"
    return (
        f"controller {VERSION} {peer.participant} {side} {1000 * peer.period_s:g} {limits.cdbs_ma:g} {limits.min_ma:g} {limits.max_ma:g} "
        f"{WATCHDOG}\n"
    )


def amplitude_line(seq: int, now_s: float, decision: Decision) -> str:
    """Write the message of a decision."""
    what = "cdbs" if decision.fallback else "policy"
    return f"amplitude {seq} {1000 * now_s:.0f} {decision.amplitude_ma:.6g} {what} {','.join(reason_names(decision.reasons)) or '-'}\n"


def end_line(seq: int, now_s: float, cdbs_ma: float, how: str) -> str:
    """Write the last message of a session."""
    return f"end {seq} {1000 * now_s:.0f} {cdbs_ma:.6g} {how}\n"
