"""The compiled part of `scan`: a strict parser of RC+S stream packets over raw bytes.

Functions return the place behind what they read, or minus the place where they failed; the caller says what that means.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeVar, cast

import numpy as np
from numba import njit

from ml.formats.rcs.packets.scan import ARRAYS, SCALARS

F = TypeVar("F", bound=Callable[..., Any])

_PACKET, _HEADER, _TIMESTAMP, _CHANNEL, _CHANNELS = range(5)  # place of a name in a packet
_NUMBER, _FLAG, _OBJECT, _ARRAY, _LIST, _TEXT = range(6)  # what kind of value belongs to it

_WORDS: Final = ("millivolts", "centiG")
_FIELDS: Final = (
    (_PACKET, _OBJECT, "Header"),
    *((_HEADER, _NUMBER, name) for name in ("dataSize", "dataType", "dataTypeSequence", "globalSequence", "info", "systemTick")),
    (_HEADER, _OBJECT, "timestamp"),
    (_TIMESTAMP, _NUMBER, "seconds"),
    (_HEADER, _NUMBER, "user1"),
    (_HEADER, _NUMBER, "user2"),
    (_PACKET, _NUMBER, "PacketGenTime"),
    (_PACKET, _NUMBER, "PacketRxUnixTime"),
    (_PACKET, _LIST, "ChannelSamples"),
    (_CHANNEL, _NUMBER, "Key"),
    (_CHANNEL, _ARRAY, "Value"),
    (_PACKET, _NUMBER, "DebugInfo"),
    (_PACKET, _ARRAY, "EvokedMarker"),
    (_PACKET, _NUMBER, "IncludedChannels"),
    (_PACKET, _ARRAY, "Bands"),
    (_PACKET, _NUMBER, "ExternalValuesMask"),
    (_PACKET, _NUMBER, "Channel"),
    (_PACKET, _ARRAY, "FftOutput"),
    (_PACKET, _NUMBER, "FftSize"),
    (_PACKET, _FLAG, "IsPowerChannelOverrange"),
    (_PACKET, _NUMBER, "SampleRate"),
    (_PACKET, _TEXT, "Units"),
    (_PACKET, _NUMBER, "ValidDataMask"),
    (_PACKET, _ARRAY, "XSamples"),
    (_PACKET, _ARRAY, "YSamples"),
    (_PACKET, _ARRAY, "ZSamples"),
    (_PACKET, _NUMBER, "LatencyMilliseconds"),
)
_COUNT: Final = len(_FIELDS)
_KEY: Final = next(i for i, (_, _, name) in enumerate(_FIELDS) if name == "Key")
_VALUE: Final = _KEY + 1
_PLACES = np.array([place for place, _, _ in _FIELDS], dtype=np.int64)
_KINDS = np.array([kind for _, kind, _ in _FIELDS], dtype=np.int64)
_SLOTS = np.array(
    [SCALARS.index(name) if name in SCALARS else ARRAYS.index(name) if name in ARRAYS else -1 for _, _, name in _FIELDS], dtype=np.int64
)
_SIZES = np.array([len(name) for _, _, name in _FIELDS], dtype=np.int64)
_NAMES = np.frombuffer("".join(name.ljust(32, "\0") for _, _, name in _FIELDS).encode(), dtype=np.uint8).reshape(_COUNT, 32).copy()
_WORD_BYTES = np.frombuffer("".join(f'{word}"'.ljust(32, "\0") for word in _WORDS).encode(), dtype=np.uint8).reshape(-1, 32).copy()
_WORD_SIZES = np.array([len(word) + 1 for word in _WORDS], dtype=np.int64)
_POWERS = np.array([10.0**k for k in range(23)])


def compiled(function: F) -> F:
    """Apply numba's `njit` without the interpreter's lock, under the function's own type; cached on disk where a folder can be written."""
    try:
        return cast(F, njit(cache=True, nogil=True, error_model="numpy")(function))
    except RuntimeError:  # neither the package's folder nor the user's cache can be written: every process compiles
        return cast(F, njit(nogil=True, error_model="numpy")(function))


@compiled
def copy_runs(pool: Any, starts: Any, lengths: Any, out: Any) -> None:
    at = 0
    for i in range(starts.size):
        for j in range(lengths[i]):
            out[at + j] = pool[starts[i] + j]
        at += lengths[i]


@compiled
def read_packets(
    text: Any, at: int, end: int, scalars: Any, starts: Any, lengths: Any, pool: Any, hard: Any
) -> tuple[int, int, int, int, int]:
    """Return packets read, numbers in pool and `hard`, end of the last packet, and where reading failed (-1: it only stopped)."""
    count, used, difficult, stop = 0, 0, 0, at
    while count < scalars.shape[0]:
        i, fresh, more = _packet(text, at, count, scalars, starts[count], lengths[count], pool, used, hard, difficult)
        if i < 0 or i > end:
            lengths[count, :] = -1
            return count, used, difficult, stop, (-i if i < 0 else end)
        count, used, difficult, stop = count + 1, fresh, more, i
        i = _blank(text, i)
        if text[i] != 44:
            return count, used, difficult, stop, -1
        i = _blank(text, i + 1)
        if text[i] != 123:
            return count, used, difficult, stop, -1
        at = i
    return count, used, difficult, stop, -1


@compiled
def _packet(
    text: Any, i: int, row: int, scalars: Any, starts: Any, lengths: Any, pool: Any, used: int, hard: Any, difficult: int
) -> tuple[int, int, int]:
    """Read one packet from its `{` on. Returns where it ends, or minus the place of the failure, and the numbers then in pool and
    `hard`."""
    place, wanted, guess = _PACKET, 0, 0  # wanted: 0 after `{` or `[`, 1 after a value, 2 after a comma
    seen = np.zeros(_COUNT, dtype=np.bool_)
    key, begin, size = -1.0, 0, -1
    i += 1
    while True:
        i = _blank(text, i)
        mark = text[i]
        if mark == 44 and wanted == 1:
            wanted = 2
            i += 1
        elif place == _CHANNELS:
            if mark == 123 and wanted != 1:
                place, wanted, key, size = _CHANNEL, 0, -1.0, -1
                seen[_KEY] = seen[_VALUE] = False
            elif mark == 93 and wanted != 2:
                place, wanted = _PACKET, 1
            else:
                return -i, used, difficult
            i += 1
        elif mark == 125 and wanted != 2:
            i += 1
            wanted = 1
            if place == _PACKET:
                return i, used, difficult
            if place == _CHANNEL:
                slot = int(key) if 0.0 <= key <= 3.0 else -1
                if slot < 0 or slot != key or size < 0 or lengths[slot] >= 0:
                    return -i, used, difficult
                starts[slot], lengths[slot] = begin, size
                place = _CHANNELS
            else:
                place = _HEADER if place == _TIMESTAMP else _PACKET
        elif mark == 34 and wanted != 1:
            f = _field(text, i + 1, place, guess)
            if f < 0 or seen[f]:
                return -i, used, difficult
            seen[f], guess = True, f + 1
            i = _blank(text, i + int(_SIZES[f]) + 2)
            if text[i] != 58:
                return -i, used, difficult
            i = _blank(text, i + 1)
            kind, slot = _KINDS[f], _SLOTS[f]
            wanted = 1
            if kind == _NUMBER:
                begun = i
                i, value = _number(text, i)
                if i < 0:
                    return i, used, difficult
                if value != value and slot >= 0:
                    hard[difficult, 0], hard[difficult, 1] = begun, -1 - (row * scalars.shape[1] + slot)
                    difficult += 1
                if place == _CHANNEL:
                    key = value
                elif slot >= 0:
                    scalars[row, slot] = value
            elif kind == _ARRAY:
                first, easy = used, difficult
                i, used, difficult = _array(text, i, pool, used, hard, difficult)
                if i < 0:
                    return i, used, difficult
                if place == _CHANNEL:
                    begin, size = first, used - first
                elif slot >= 0:
                    starts[slot], lengths[slot] = first, used - first
                else:
                    used, difficult = first, easy
            elif kind == _FLAG:
                i, value = _flag(text, i)
                if i < 0:
                    return i, used, difficult
                scalars[row, slot] = value
            elif kind == _TEXT:
                i = _word(text, i)
                if i < 0:
                    return i, used, difficult
            else:
                if text[i] != (91 if kind == _LIST else 123):
                    return -i, used, difficult
                place = _CHANNELS if kind == _LIST else _HEADER if place == _PACKET else _TIMESTAMP
                wanted = 0
                i += 1
        else:
            return -i, used, difficult


@compiled
def _blank(text: Any, i: int) -> int:
    """Find the next place that has no blank of JSON."""
    while text[i] == 32 or 9 <= text[i] <= 10 or text[i] == 13:
        i += 1
    return i


@compiled
def _field(text: Any, i: int, place: int, guess: int) -> int:
    """Find the number of the field with this name and closing quote, -1 for a name not known at this place; `guess` is tried first."""
    for k in range(_COUNT):
        f = (guess + k) % _COUNT
        if _PLACES[f] == place and text[i + _SIZES[f]] == 34:
            same = True
            for j in range(_SIZES[f]):
                if text[i + j] != _NAMES[f, j]:
                    same = False
                    break
            if same:
                return f
    return -1


@compiled
def _number(text: Any, i: int) -> tuple[int, float]:
    """Read a JSON number. Returns the place behind it, or minus the place of the failure, and its value, NaN for one that `float` must
    read."""
    negative = int(text[i] == 45)
    i += negative
    first = i
    mantissa = np.int64(0)
    digit = int(text[i]) - 48
    while 0 <= digit <= 9:
        mantissa = mantissa * 10 + digit
        i += 1
        digit = int(text[i]) - 48
    if i == first or (i > first + 1 and text[first] == 48):
        return -i, 0.0
    whole = i
    shift = 0
    if text[i] == 46:
        i += 1
        point = i
        digit = int(text[i]) - 48
        while 0 <= digit <= 9:
            mantissa = mantissa * 10 + digit
            i += 1
            digit = int(text[i]) - 48
        shift = point - i
        if shift == 0:
            return -i, 0.0
    digits = i - first
    if text[i] | 32 == 101:
        i += 1
        falling = text[i] == 45
        if falling or text[i] == 43:
            i += 1
        point, power = i, 0
        while 48 <= text[i] <= 57:
            power = power * 10 + (int(text[i]) - 48) if power < 1000 else power
            i += 1
        if i == point:
            return -i, 0.0
        shift += -power if falling else power
    if digits > 18 or mantissa > 9007199254740992 or shift < -22 or shift > 22:
        return i, np.nan
    if mantissa == 0 and i == whole:
        return i, 0.0  # whole numbers have no negative zero
    value = mantissa / _POWERS[-shift] if shift < 0 else mantissa * _POWERS[shift]
    return i, value * (1.0 - 2.0 * negative)


@compiled
def _array(text: Any, i: int, pool: Any, used: int, hard: Any, difficult: int) -> tuple[int, int, int]:
    """Read a list of numbers. Returns the place behind it, or minus the place of the failure, and the numbers in pool and `hard`."""
    if text[i] != 91:
        return -i, used, difficult
    i = _blank(text, i + 1)
    if text[i] == 93:
        return i + 1, used, difficult
    while True:
        begun = i
        i, value = _number(text, i)
        if i < 0:
            return i, used, difficult
        if value != value:
            hard[difficult, 0], hard[difficult, 1] = begun, used
            difficult += 1
        pool[used] = value
        used += 1
        if text[i] != 44:
            i = _blank(text, i)
            if text[i] == 93:
                return i + 1, used, difficult
            if text[i] != 44:
                return -i, used, difficult
        i += 1
        if text[i] <= 32:
            i = _blank(text, i)


@compiled
def _flag(text: Any, i: int) -> tuple[int, float]:
    """Read `true` or `false`. Returns the place behind it, or minus the place of the failure, and 1 or 0."""
    if text[i] == 116 and text[i + 1] == 114 and text[i + 2] == 117 and text[i + 3] == 101:
        return i + 4, 1.0
    if text[i] == 102 and text[i + 1] == 97 and text[i + 2] == 108 and text[i + 3] == 115 and text[i + 4] == 101:
        return i + 5, 0.0
    return -i, 0.0


@compiled
def _word(text: Any, i: int) -> int:
    """Read one of the known words in quotes. Returns the place behind it, or minus the place of the failure."""
    if text[i] == 34:
        for w in range(_WORD_SIZES.size):
            same = True
            for j in range(_WORD_SIZES[w]):
                if text[i + 1 + j] != _WORD_BYTES[w, j]:
                    same = False
                    break
            if same:
                return i + 1 + int(_WORD_SIZES[w])
    return -i
