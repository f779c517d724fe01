from __future__ import annotations

import io
import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.formats.rcs.packets.json_elements import JsonNotes, read_elements

HEAD = '[{"RecordInfo":{"DeviceId":"NPC7","HostUnixTime":5},"TimeDomainData":['


def packet(i, pad=0):
    return {"Header": {"systemTick": i}, "ChannelSamples": [{"Key": 0, "Value": [0.1 * i, -1e-6] + [0.5] * pad}]}


def whole(count=5, pad=0):
    return HEAD + ",".join(json.dumps(packet(i, pad)) for i in range(count)) + "]}]"


def read(text):
    notes = JsonNotes()
    raw = text if isinstance(text, bytes) else text.encode()
    return [value for value, _ in read_elements(io.BytesIO(raw), notes)], notes


def ticks(values):
    return [v["Header"]["systemTick"] for v in values]


def test_a_whole_stream_gives_its_packets_and_no_defects():
    values, notes = read(whole())
    assert values == [packet(i) for i in range(5)]
    assert (notes.defects, notes.stream_key, notes.record_infos[0]["DeviceId"]) == ([], "TimeDomainData", "NPC7")


@pytest.mark.parametrize(
    "tail", ['],"Extra":5}]', '], "A" : {"b":[1,2]} , "C":"x"}]', '],"Long":"' + "y" * 3_000_000 + '"}]', '],"Extra":5}\n]\n']
)
def test_a_file_with_fields_behind_its_packets_is_whole(tail):
    values, notes = read(whole()[:-3] + tail)
    assert ticks(values) == list(range(5))
    assert notes.defects == []
    assert notes.unread_fields == tail.count('":') + tail.count('" :') - tail.count('"b"')


def test_fields_behind_the_packets_hide_neither_a_cut_end_nor_the_next_object():
    values, notes = read(whole()[:-3] + '],"Extra":5')
    assert ticks(values) == list(range(5))
    assert notes.defects == ["the end of the file is missing; every complete part before it was kept"]
    values, notes = read(whole()[:-3] + '],"Extra":5},' + whole(2)[1:])
    assert ticks(values) == [0, 1, 2, 3, 4, 0, 1]
    assert notes.defects == []


def test_a_second_list_of_packets_in_one_object_is_said_to_be_left_out():
    values, notes = read(whole()[:-3] + '],"AccelData":[{"Header":{"systemTick":9}}]}]')
    assert ticks(values) == list(range(5))
    assert notes.defects == ["a second list of packets in one object (AccelData) was left out"]


def test_packets_across_chunks_of_a_large_file_are_whole():
    values, notes = read(whole(300, pad=2000))
    assert ticks(values) == list(range(300))
    assert notes.defects == []


@given(cut=st.integers(1, len(whole()) - 1))
def test_wherever_a_file_is_cut_every_complete_packet_before_is_kept(cut):
    text = whole()[:cut]
    complete = sum(1 for i in range(5) if text.find(json.dumps(packet(i))) >= 0)
    values, notes = read(text)
    assert values == [packet(i) for i in range(complete)]
    assert notes.defects


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        (whole().replace('"systemTick": 2', '"systemTick": 2 2'), [0, 1, 3, 4]),
        (whole()[:-2] + "]", [0, 1, 2, 3, 4]),
        (whole()[:-3] + ",]}]", [0, 1, 2, 3, 4]),
        ("\ufeff" + whole(), [0, 1, 2, 3, 4]),
        (whole().replace("}, {", "},,{"), [0, 1, 2, 3, 4]),
    ],
)
def test_a_defect_costs_only_the_packet_it_is_in(text, kept):
    assert ticks(read(text)[0]) == kept


@pytest.mark.parametrize("token", ["INF", "-INF", "Inf", "NaN", "Infinity"])
def test_numbers_that_are_none_are_read(token):
    values, _ = read(whole().replace("-1e-06", token, 3))
    assert ticks(values) == [0, 1, 2, 3, 4]
    assert not math.isfinite(values[1]["ChannelSamples"][0]["Value"][1])


def test_inf_in_every_packet_of_a_large_file_is_mended_in_one_go():
    values, notes = read(whole(3000, pad=200).replace("-1e-06", "INF"))
    assert len(values) == 3000
    assert notes.defects == ["INF in place of a number, read as infinite"]


def test_records_and_empty_streams_are_told_apart():
    records = [{"RecordInfo": {"HostUnixTime": i}, "x": {"TimeDomainData": i}} for i in range(3)]
    assert read(json.dumps(records))[0] == records
    values, notes = read('[{"RecordInfo":{},"PowerDomainData":[]}]')
    assert (values, notes.stream_key, notes.defects) == ([], "PowerDomainData", [])
    assert read("[]")[1].defects == []
    assert read("")[1].defects == ["the file is empty"]


def test_two_stream_objects_in_one_file_are_both_read():
    text = whole(2)[:-1] + "," + whole(3)[1:]
    assert ticks(read(text)[0]) == [0, 1, 0, 1, 2]


def test_deep_nesting_costs_that_packet_and_nothing_else():
    deep = '{"Header":' + "[" * 200_000 + "]" * 200_000 + "}"
    values, notes = read(HEAD + json.dumps(packet(0)) + "," + deep + "," + json.dumps(packet(2)) + "]}]")
    assert ticks(values) == [0, 2]
    assert any("nested deeper" in text for text in notes.defects)


def test_endless_damage_is_given_up():
    values, notes = read(HEAD + '{"Header" x},' * 5000)
    assert values == []
    assert any("more than 1000 damaged packets" in text for text in notes.defects)


@given(raw=st.binary(max_size=400))
def test_no_bytes_whatever_raise(raw):
    for content in (raw, HEAD.encode() + raw, b"[" + raw):
        found, notes = read(content)
        assert isinstance(found, list)
        assert all(isinstance(defect, str) for defect in notes.defects)
