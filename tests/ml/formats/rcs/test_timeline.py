"""One timeline for all streams, on recordings whose true times, losses and clock steps are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ml.formats import decode
from ml.formats.rcs.packets.headers import PacketHeaders
from ml.formats.rcs.packets.loss import loss_of
from ml.formats.rcs.packets.time import reconstruct, reconstruct_all
from ml.formats.rejection import Rejected

START_MS = 1.7e12
FOLDER = "Session1700000000000/DeviceNPC799999H/"
RATE = 500.0
PER_PACKET = 50


def packets(count=380, keep=None, first_s=3.0, noise_ms=0.0, drift=0.0, implant_step=(0, 0.0), pc_step=(0, 0.0)):
    """Build packets of 100 ms, and their true times in ms of the implant's ticks.

    Steps are (packet from which the clock is set, by how many s); `drift` is the gain of the PC's clock on the implant's.
    """
    index = np.arange(count) if keep is None else np.asarray(keep)
    t = (index + 1) * PER_PACKET / RATE
    ticks = np.rint((first_s + t) * 10_000).astype(np.int64)
    noise = np.random.default_rng(3).normal(0, noise_ms, t.size) if noise_ms else 0.0
    gen = START_MS + 1000 * t * (1 + drift) + noise + 1000 * pc_step[1] * (index >= pc_step[0])
    headers = PacketHeaders(
        seconds=(700_000_000 + ticks // 10_000 + int(implant_step[1]) * (index >= implant_step[0])).astype(np.int64),
        tick=ticks % 65_536,
        gen_ms=gen,
        rx_ms=gen + 40.0,
        sequence=index % 256,
        samples=np.full(t.size, PER_PACKET),
        rate_hz=np.full(t.size, RATE),
    )
    return headers, START_MS + 1000 * t


@pytest.mark.parametrize("by_s", [3600.0, -30.0, -3600.0, 7.0, 2.0])
@pytest.mark.parametrize("at", [131, 379 - 20])
def test_a_step_of_the_implants_clock_loses_nothing_and_is_told(by_s, at):
    headers, true = packets(implant_step=(at, by_s))
    found = reconstruct_all({"td": headers}, {})
    times = found.streams["td"]
    assert (times.rejected, times.missing, times.chunks, times.loss) == ({}, 0, 1, 0.0)
    np.testing.assert_allclose(times.last_ms, true, atol=1e-3)
    ((at_ms, step_ms),) = found.implant_steps
    assert step_ms == pytest.approx(1000 * by_s, abs=150)
    assert at_ms == pytest.approx(true[at], abs=1100)


@pytest.mark.parametrize("by_s", [10.0, -10.0, 3600.0, 0.8, -0.8])
def test_a_step_of_the_computers_clock_loses_nothing_and_is_told(by_s):
    headers, true = packets(pc_step=(249, by_s), noise_ms=20.0)
    found = reconstruct_all({"td": headers}, {})
    times, clock = found.streams["td"], found.clock
    assert (times.rejected, times.missing, times.chunks) == ({}, 0, 1)
    np.testing.assert_allclose(times.last_ms, true, atol=6.0)
    np.testing.assert_allclose(clock.steps_ms, [1000 * by_s], atol=10.0)
    np.testing.assert_allclose(clock.timeline_ms(clock.steps_at_ms), true[249], atol=101.0)


def test_what_the_computer_logged_after_its_clock_was_set_stands_where_it_happened():
    headers, true = packets(pc_step=(249, 10.0))
    clock = reconstruct_all({"td": headers}, {}).clock
    happened = np.array([true[50], true[200], true[300], true[350]])
    logged = happened + 10_000.0 * (happened >= true[249])
    np.testing.assert_allclose(clock.of_pc_ms(logged), happened, atol=1.0)


@pytest.mark.parametrize(("by_s", "doubtful"), [(3.0, True), (7.0, False), (-3.0, True), (-30.0, True)])
def test_a_record_within_lost_packets_has_no_place_where_two_times_fit(by_s, doubtful):
    """Packets 150 to 209 are lost (6 s) and the clock is set at the 170th; the record is of the 174th."""
    headers, true = packets(keep=np.concatenate((np.arange(150), np.arange(210, 380))), pc_step=(170, by_s))
    clock = reconstruct_all({"td": headers}, {}).clock
    happened = true[149] + 2_500.0
    spans = clock.doubtful_ms([happened + 1000.0 * by_s])
    assert bool(spans) == doubtful
    for begin, end in spans:
        # the timeline is that of the most packets, which come after the step
        assert begin <= true[149] + 1000.0 * by_s + min(0.0, 1000.0 * by_s)
        assert end >= true[150] + 1000.0 * by_s
    if not doubtful:
        np.testing.assert_allclose(clock.of_pc_ms(np.array([happened + 1000.0 * by_s])), [happened], atol=1.0)


def test_a_record_far_from_a_step_among_lost_packets_keeps_its_place():
    headers, true = packets(keep=np.concatenate((np.arange(150), np.arange(210, 380))), pc_step=(170, 3.0))
    clock = reconstruct_all({"td": headers}, {}).clock
    assert clock.doubtful_ms([true[100], true[200] + 3_000.0]) == []


@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize("at_end", [False, True])
def test_a_step_next_to_the_first_or_last_packets_is_told(count, at_end):
    headers, true = packets(pc_step=(380 - count if at_end else count, 3.0), noise_ms=20.0)
    clock = reconstruct_all({"td": headers}, {}).clock
    np.testing.assert_allclose(clock.steps_ms, [3000.0], atol=60.0)
    assert clock.timeline_ms(clock.steps_at_ms) == pytest.approx(
        [true[380 - count if at_end else count] + (0 if at_end else 3000.0)], abs=60
    )


def test_a_step_of_either_clock_within_lost_packets_moves_nothing():
    kept = np.concatenate((np.arange(150), np.arange(210, 380)))
    for steps in ({"implant_step": (200, 3600.0)}, {"pc_step": (200, 10.0)}):
        headers, true = packets(keep=kept, **steps)
        times = reconstruct(headers)
        assert (times.missing, times.chunks, times.loss) == (60, 2, pytest.approx(60 / 380))
        np.testing.assert_allclose(times.last_ms, true, atol=1e-3)


def test_the_wander_of_the_computers_estimate_moves_no_stretch_against_another():
    kept = [i for i in range(600) if i % 7]
    headers, true = packets(keep=kept)
    wander = 100.0 * np.sin(np.arange(len(kept)) / 25.0)
    times = reconstruct(dataclasses.replace(headers, gen_ms=headers.gen_ms + wander))
    apart = times.last_ms - true
    assert np.ptp(apart) < 1e-6
    np.testing.assert_allclose(times.residual_ms, wander, atol=25.0)


def test_drift_of_the_clocks_is_told_and_stretches_no_signal():
    headers, true = packets(count=6000, drift=9e-5, noise_ms=20.0)
    found = reconstruct_all({"td": headers}, {})
    np.testing.assert_allclose(np.diff(found.streams["td"].last_ms), 100.0, atol=1e-6)
    assert found.clock.drift == pytest.approx(-9e-5, abs=5e-6)
    logged = START_MS + (true[5900] - START_MS) * (1 + 9e-5)
    np.testing.assert_allclose(found.clock.of_pc_ms(np.array([logged])), true[5900], atol=8.0)


def test_streams_share_the_ticks_whatever_their_own_packet_times_say():
    headers, true = packets(count=600, first_s=5.9)
    other = headers.take(np.arange(1, 600, 10))
    shifted = dataclasses.replace(other, gen_ms=other.gen_ms + 45.0, samples=np.ones(60, dtype=np.int64), rate_hz=np.ones(60))
    bare = dataclasses.replace(shifted, gen_ms=np.full(60, -62135568000000.0), rx_ms=np.full(60, np.nan))
    found = reconstruct_all({"td": headers, "sync": shifted, "bare": bare}, {}).streams
    np.testing.assert_allclose(found["td"].last_ms - true, found["td"].last_ms[0] - true[0], atol=1e-6)
    for name in ("sync", "bare"):
        np.testing.assert_allclose(found[name].last_ms, found["td"].last_ms[1::10], atol=1e-6)


def test_ticks_turn_many_times_in_a_silence_longer_than_their_turn():
    kept = np.concatenate((np.arange(100), np.arange(100 + 7 * 256 + 3, 2200)))
    headers, true = packets(keep=kept)
    times = reconstruct(headers)
    np.testing.assert_allclose(times.last_ms, true, atol=1e-3)
    assert times.missing == 7 * 256 + 3


def test_loss_is_what_is_missing_of_the_signal():
    """After a lost packet the device sends half a packet: one number is missing, and the signal of two and a half packets."""
    headers, _ = packets(count=100)
    samples = headers.samples.copy()
    keep = np.delete(np.arange(100), [40, 41])
    sequence = headers.sequence.copy()
    sequence[42:] -= 1
    samples[42] = PER_PACKET // 2
    times = reconstruct(dataclasses.replace(headers, sequence=sequence, samples=samples).take(keep))
    assert times.missing == 1
    assert times.gaps.missing_ms.tolist() == pytest.approx([250.0])
    assert times.loss == pytest.approx(0.25 / 10.0)


def test_what_settings_say_was_switched_off_is_no_loss():
    headers, true = packets(keep=np.concatenate((np.arange(50), np.arange(90, 200))))
    times = reconstruct(headers)
    half = float(true[49] + 2000)
    lost = loss_of(times.gaps, times.received_ms, [(half, half + 1e9)])
    assert (lost.packets, lost.missing_s, lost.paused_s) == (20, pytest.approx(2.0), pytest.approx(2.0))
    assert lost.share == pytest.approx(2.0 / 18.0)
    assert loss_of(times.gaps, times.received_ms, []).share == pytest.approx(0.2)


def test_equal_headers_with_other_samples_are_two_packets():
    headers, true = packets(count=200)
    tick, sequence, seconds = headers.tick.copy(), headers.sequence.copy(), headers.seconds.copy()
    tick[99], sequence[99], seconds[99] = tick[100], sequence[100], seconds[100]  # written under the header of the next
    raced = dataclasses.replace(headers, tick=tick, sequence=sequence, seconds=seconds)
    times = reconstruct(raced, same=lambda i, j: False)
    assert (times.rejected, times.moved, times.missing, times.chunks) == ({}, 1, 0, 1)
    np.testing.assert_allclose(times.last_ms, true, atol=1e-3)


def test_a_run_of_packets_under_the_clocks_of_the_next_is_put_back():
    headers, true = packets(count=200)
    shifted = np.arange(200)
    shifted[97:100] += 1
    tick, seconds = headers.tick[shifted], headers.seconds[shifted]
    times = reconstruct(dataclasses.replace(headers, tick=tick, seconds=seconds), same=lambda i, j: False)
    assert (times.rejected, times.moved, times.chunks) == ({}, 3, 1)
    np.testing.assert_allclose(times.last_ms, true, atol=1e-3)


def test_equal_headers_with_equal_samples_are_one_packet():
    headers, _ = packets(count=200)
    order = np.insert(np.arange(200), [101, 140], [100, 100])
    times = reconstruct(headers.take(order), same=lambda i, j: order[i] == order[j])
    assert times.rejected == {Rejected.DUPLICATE: 2}
    assert (times.chunks, times.missing, times.reordered, times.moved) == (1, 0, 1, 0)


def test_late_packets_are_told_and_kept():
    headers, true = packets(count=200)
    rx = headers.rx_ms.copy()
    rx[120:123] += 700.0
    rx[130] += 300.0
    times = reconstruct(dataclasses.replace(headers, rx_ms=rx))
    assert (times.late, times.reordered, times.missing) == (3, 0, 0)
    np.testing.assert_allclose(times.last_ms, true, atol=1e-3)


def session(rcs, pack, td, **more):
    named = {"DeviceSettings": rcs.settings(), "RawDataTD": td, **more}
    return decode(pack({f"{FOLDER}{stem}.json": content for stem, content in named.items()}))


def test_a_recording_says_how_its_clocks_ran_and_repairs_nothing_that_is_lost(rcs, pack):
    td = rcs.time_domain(0.02 * np.sin(2 * np.pi * 20 * np.arange(20_000) / 500), lost=(30, 31))
    for packet in td[0]["TimeDomainData"][200:]:
        packet["PacketGenTime"] += 10_000
        packet["PacketRxUnixTime"] += 10_000
    stim = rcs.stim((0.0, {"therapyStatusData": {"activeGroup": 0, "therapyStatus": 1}}), (35.0, rcs.program(2.5)))
    decoded = session(rcs, pack, td, StimLog=stim)
    (recording,) = decoded.recordings
    clock, told = recording.quality["clock"], recording.quality["time_domain"]
    assert recording.duration_s == pytest.approx(40.0, abs=0.01)
    assert [step[1] for step in clock["pc_steps"]] == [10.0]
    assert clock["pc_steps"][0][0] == pytest.approx(20.2, abs=0.11)
    assert len(clock["residual_ms"]) == len(clock["residual_t_s"]) <= 240
    assert max(map(abs, clock["residual_ms"])) < 2
    assert (told["missing"], told["missing_s"], told["loss"]) == (2, 0.2, 0.005)
    # 35 s on the computer's clock after it was set forward by 10 s
    assert [e.t_s for e in recording.events if "2.5 mA" in e.label] == [pytest.approx(25.0, abs=0.01)]
    about = next(r for r in decoded.reports if r.name == "RawDataTD.json")
    assert about.repaired == []
    assert about.flagged == [
        "0.5 % of the signal is missing (0.2 s; 2 packets lost); 2 stretches without a gap",
        "the computer's clock was set by +10.0 s after 20.3 s; times follow the implant's ticks. The start is by one of its two times, and "
        "may be off by that",
    ]


def test_a_packet_that_only_looks_like_the_one_before_counts(rcs, pack):
    td = rcs.time_domain(0.02 * np.sin(2 * np.pi * 20.3 * np.arange(20_000) / 500))
    listed = td[0]["TimeDomainData"]
    listed[99]["Header"] = dict(listed[100]["Header"])
    listed.insert(151, listed[150])
    (recording,) = session(rcs, pack, td).recordings
    told = recording.quality["time_domain"]
    assert (told["rejected"], told["moved"], told["missing"], told["chunks"]) == ({"duplicate": 1}, 1, 0, 1)
    beta = next(t for t in recording.traces if t.stream == "beta")
    np.testing.assert_allclose(beta.values[1:-1], 1000 * 0.02 / np.sqrt(2), rtol=0.01)
