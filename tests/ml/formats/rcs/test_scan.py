"""The compiled scanner against the plain definition of what it reads, over whatever a file may hold."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.formats.rcs.folder import _batches
from ml.formats.rcs.packets.json_elements import JsonNotes, read_elements
from ml.formats.rcs.packets.scan import ARRAYS, PADDING, SCALARS, batch_of, join, scan

HEAD = '[{"RecordInfo":{"DeviceId":"NPC7"},"TimeDomainData":['
HEADER = {"dataSize": 4, "dataTypeSequence": 255, "systemTick": 65535, "timestamp": {"seconds": 700000000}, "user1": 1}
PACKET = {
    "Header": HEADER,
    "PacketGenTime": -62135568000000,
    "PacketRxUnixTime": 1563323148994,
    "ChannelSamples": [{"Key": 2, "Value": [0.095528, -0.040411999999999997]}, {"Key": 0, "Value": [1e-06, -2]}],
    "EvokedMarker": [],
    "SampleRate": 1,
    "Units": "millivolts",
    "Bands": [0, 1, 2, 3, 4, 5, 6, 4294967295],
    "IsPowerChannelOverrange": True,
    "LatencyMilliseconds": 29.843500000000002,
}

numbers = st.one_of(
    st.integers(-(10**20), 10**20), st.floats(allow_nan=False, allow_infinity=False), st.floats(-1, 1).map(lambda x: round(x, 6))
)
channels = st.lists(
    st.fixed_dictionaries({"Key": st.integers(-1, 5) | numbers, "Value": st.lists(numbers, max_size=4) | st.none()}), max_size=5
)
values = {
    "Header": st.fixed_dictionaries({}, optional={"systemTick": numbers, "dataTypeSequence": numbers, "info": numbers, "odd": numbers})
    | st.none(),
    "ChannelSamples": channels,
    "EvokedMarker": st.lists(numbers, max_size=2),
    "Units": st.sampled_from(["millivolts", "centiG", "furlongs"]),
    "IsPowerChannelOverrange": st.booleans() | st.none(),
    "Bands": st.lists(numbers | st.none(), max_size=9),
    "PacketGenTime": numbers | st.booleans(),
    "FftSize": numbers,
    "strange": st.text(max_size=3),
}
packets = st.fixed_dictionaries({}, optional=values)


def assert_same(found, expected):
    np.testing.assert_array_equal(found.scalars, expected.scalars)
    np.testing.assert_array_equal(found.lengths, expected.lengths)
    rows = np.arange(expected.size)
    for name in ARRAYS:
        np.testing.assert_array_equal(join(found, name, rows), join(expected, name, rows))


def scanned(text):
    return scan(text.encode() + PADDING, 0)


def gathered(text, scanner):
    """Gather all packets of a file as one list of rows, so that runs may be cut anywhere."""
    rows = []
    notes = JsonNotes()
    for batch in _batches(value for value, _ in read_elements(io.BytesIO(text.encode()), notes, scanner)):
        for i in range(batch.size):
            rows.append(
                (batch.scalars[i].tolist(), [join(batch, name, np.array([i])).tolist() for name in ARRAYS], batch.lengths[i].tolist())
            )
    return rows, notes.elements, notes.defects


@pytest.mark.parametrize("layout", [{"separators": (",", ":")}, {"indent": 1}])
def test_a_packet_comes_out_with_every_number_exact(layout):
    batch, end, _ = scanned(text := json.dumps(PACKET, **layout))
    assert (batch.size, end) == (1, len(text))
    assert_same(batch, batch_of([PACKET]))
    assert join(batch, "key 2", np.array([0])).tolist() == [0.095528, -0.040411999999999997]
    assert batch.column("LatencyMilliseconds")[0] == 29.843500000000002
    assert batch.lengths[0, ARRAYS.index("key 1")] == -1
    assert set(SCALARS) > {"seconds", "systemTick"}


@given(st.lists(numbers, min_size=1, max_size=20))
def test_every_number_is_the_one_that_python_reads(listed):
    text = json.dumps({"FftOutput": listed})
    batch, end, _ = scanned(text)
    assert end == len(text)
    expected = [float(x) if abs(x) < 1e300 else np.nan for x in listed]
    np.testing.assert_array_equal(join(batch, "FftOutput", np.array([0])), expected)


@pytest.mark.parametrize("number", [2**64 + 1, 2**53 + 1, 0.1 + 2**-55, 1e22, 1e23, 9e-23, 5e-324, -0.0, 123456789012345678])
def test_numbers_beyond_the_exact_doubles_are_right_to_the_last_bit(number):
    text = json.dumps({"EvokedMarker": [number, 0.040411999999999997], "FftOutput": [1.5, number], "FftSize": number})
    batch, end, _ = scanned(text)
    assert end == len(text)
    found = [*join(batch, "FftOutput", np.array([0])), batch.column("FftSize")[0]]
    assert [x.hex() for x in found] == [x.hex() for x in (1.5, float(number), float(number))]


@given(st.lists(packets, min_size=1, max_size=4))
def test_whatever_the_packets_hold_they_are_read_as_the_definition_says(listed):
    text = json.dumps(listed)[1:-1]
    batch, end, _ = scanned(text)
    assert_same(batch, batch_of(listed[: batch.size]))
    assert end == len(json.dumps(listed[: batch.size])) - 2 if batch.size else end == 0
    assert repr(gathered(HEAD + text + "]}]", scan)) == repr(gathered(HEAD + text + "]}]", None))


@given(at=st.integers(0, 900), junk=st.sampled_from(["", "}", "]", ",", "NaN", "INF", "\\", '"', "0", "-", "\0", "µ", "{", " ", "e5"]))
def test_damage_anywhere_gives_the_same_packets_with_and_without_the_scanner(at, junk):
    whole = HEAD + ",".join(json.dumps(PACKET | {"FftSize": i}) for i in range(3)) + "]}]"
    for text in (whole[:at] + junk + whole[at:], whole[: at + len(HEAD)] + junk):
        fast, slow = gathered(text, scan), gathered(text, None)
        assert repr(fast) == repr(slow)


@pytest.mark.parametrize(
    "text",
    [
        '{"FftSize":01}', '{"FftSize":1.}', '{"FftSize":.5}', '{"FftSize":+1}', '{"FftSize":1e}', '{"FftSize":NaN}', '{"FftSize":1,}',
        '{,"FftSize":1}', '{"FftSize" 1}', '{"FftSize":1 "Channel":2}', '{"FftSize":1,"FftSize":2}', '{"Bands":[1,]}', '{"Bands":[1 2]}',
        '{"Bands":[,1]}', '{"ChannelSamples":[{"Key":0,"Value":[1]},]}', '{"Name":"Ada"}', '{"Units":"Ada"}', '{"seconds":5}', "{", "",
    ],
)  # fmt: skip
def test_what_is_not_plain_is_left_to_the_tolerant_reader(text):
    batch, end, _ = scanned(text)
    assert (batch.size, end) == (0, 0)


def test_a_packet_cut_by_the_end_of_the_text_is_told_from_a_bad_one():
    text = json.dumps(PACKET)
    assert scanned(text[:-40])[2]
    assert not scanned('{"Name":1,' + text[1:])[2]


def test_a_run_ends_where_its_text_would_not_be_json():
    plain = json.dumps(PACKET)
    assert [scanned(f"{plain}{between}{plain}")[0].size for between in (",", " , ", ",,", "", " ")] == [2, 2, 1, 1, 1]


@pytest.mark.parametrize("token", ["-0", "-0.0", "-0e0", "0", "-1", "-0.5E1", "1E+2"])
def test_signs_and_exponents_are_those_of_the_json_module(token):
    batch, _, _ = scanned(f'{{"FftSize":{token}}}')
    assert batch.column("FftSize")[0].hex() == float(json.loads(token)).hex()
