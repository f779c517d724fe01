"""The control channel is chosen by target and montage and can be changed; a survey of montages is no session without DBS."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from app.ingest.channels import Place, choose, is_survey, place_of
from app.study.sessions.usable_steps import Worth
from app.study.traces import pack, unpack
from app.tables.participants import Hemisphere
from app.tables.recordings import Recording, Trace
from tests.app.ingest.conftest import device_zip

LEADS = ["left STN", "", "left M1", ""]


def trace(channel: str, valid: int = 10, stream: str = "beta", **details: Any) -> Trace:
    values, bits = pack(np.ones(10, dtype=np.float32), np.arange(10) < valid)
    return Trace(stream=stream, channel=channel, n=10, values_f32=values, valid_bits=bits, details=details)


def recording(cathode: str = "", leads: list[str] = LEADS, contacts: list[list[str]] | None = None) -> Recording:
    sensing = [{"from_s": 40.0 * i - 5, "contacts": c} for i, c in enumerate(contacts or [])]
    program = {"program": 0, "amplitude_ma": 2.0, "contacts": cathode}
    events = [{"t_s": 0.0, "kind": "stimulation", "data": {"therapy_on": True, "programs": [program]}}]
    return Recording(details={"settings": {"leads": leads, "sensing": sensing}, "events": events}, duration_s=200.0, hemisphere="left")


def chosen(traces: list[Trace], where: Recording, side: Hemisphere | None = None, usable: dict[str, int] | None = None) -> str:
    def worth(trace: Trace) -> Worth:
        return Worth((usable or {}).get(trace.channel, 0), int(np.sum(~np.isnan(unpack(trace)))))

    found = choose(traces, where, side, worth)
    assert found is not None
    return found.channel


def test_a_deep_target_comes_before_cortex_whatever_has_more_valid_steps() -> None:
    both = [trace("key 2 +9-8"), trace("key 0 +2-0", valid=6)]
    assert chosen(both, recording()) == "key 0 +2-0"
    assert chosen(both, recording(leads=["", "", "", ""])) == "key 2 +9-8", "without targets the most valid steps count"
    assert chosen([trace("key 2 +9-8"), trace("key 0 +2-0", valid=6)], recording(leads=["", "", "left M1", ""])) == "key 0 +2-0"


def test_one_contact_against_itself_is_never_taken_where_there_is_another() -> None:
    assert chosen([trace("key 0 +1-1"), trace("key 1 +3-1", valid=4)], recording()) == "key 1 +3-1"
    assert chosen([trace("key 0 +1-1"), trace("key 2 +9-8", valid=4)], recording()) == "key 2 +9-8", "cortex has a signal at least"
    assert Place("", (1, 1)).shorted


def test_the_pair_around_the_stimulating_contact_comes_first_and_one_with_it_last() -> None:
    pairs = [trace("key 0 +1-0"), trace("key 1 +3-2"), trace("key 1 +2-0", valid=5)]
    assert chosen(pairs, recording("-1 +C")) == "key 1 +2-0"
    assert chosen(pairs[:2], recording("-1 +C")) == "key 1 +3-2"


def test_of_one_lead_the_channel_that_teaches_most_is_taken() -> None:
    pairs = [trace("key 0 +2-0", valid=9), trace("key 1 +3-1", valid=8), trace("key 2 +9-8")]
    assert chosen(pairs, recording()) == "key 0 +2-0"
    assert chosen(pairs, recording(), usable={"key 0 +2-0": 4, "key 1 +3-1": 10, "key 2 +9-8": 18}) == "key 1 +3-1"


def test_contacts_decide_between_channels_that_teach_about_as_much() -> None:
    pairs = [trace("key 0 +1-0"), trace("key 1 +2-0")]
    around = recording("-1 +C")
    assert chosen(pairs, around, usable={"key 0 +1-0": 20, "key 1 +2-0": 10}) == "key 1 +2-0", "half as much is about as much"
    assert chosen(pairs, around, usable={"key 0 +1-0": 20, "key 1 +2-0": 9}) == "key 0 +1-0"


def test_the_stated_side_decides_between_two_leads() -> None:
    two = ["left STN", "", "right STN", ""]
    channels = [trace("key 0 +2-0"), trace("key 2 +10-8", valid=5)]
    assert chosen(channels, recording(leads=two), Hemisphere.RIGHT) == "key 2 +10-8"
    assert chosen(channels, recording(leads=two), Hemisphere.LEFT) == "key 0 +2-0"


def test_a_power_band_is_placed_by_the_key_of_its_channel() -> None:
    where = recording(contacts=[["+2-0", "+1-1", "+9-8", "+11-10"]])
    assert place_of(trace("band 5 13.2-34.7 Hz", stream="band_power", channel_key=2), where) == Place("left M1", (9, 8))
    assert place_of(trace("band 3 13.2-34.7 Hz", stream="band_power", channel_key=1), where).shorted
    assert place_of(trace("ONE_THREE_LEFT"), recording(leads=[])) == Place("", None)


def test_a_survey_is_a_recording_that_goes_through_montages() -> None:
    pairs = [["+2-0", "", "", ""], ["+3-1", "", "", ""], ["+1-0", "", "", ""]]
    assert is_survey(recording(contacts=pairs))
    assert not is_survey(recording(contacts=[pairs[0], pairs[1], pairs[0]]))
    before = recording(contacts=pairs)
    for row, at in zip(before.details["settings"]["sensing"], (-60.0, -30.0, -1.0), strict=True):
        row["from_s"] = at
    assert not is_survey(before), "what was set and replaced before the recording began says nothing of it"


def test_a_montage_survey_of_a_patient_is_not_proposed_as_a_session_without_dbs(
    client: TestClient, participant_code: str, recordings: Path
) -> None:
    content = (recordings / "rcs" / "montage_packet_loss.zip").read_bytes()
    answer = client.post("/api/v1/uploads", data={"participant": participant_code, "visit": "1"}, files={"file": ("m.zip", content)})
    assert answer.status_code == 201, answer.text
    for proposal in answer.json()["proposals"]:
        assert proposal["session"]["controller"] is None
        assert "survey of 4 montages" in proposal["evidence"]["controller"]
        assert "M1" not in proposal["evidence"]["control"].split(";")[0]


def on_cortex(content: bytes) -> bytes:
    """Add the second bore's channel to the folder, with its lead in M1."""
    sink = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(sink, "w") as new:
        for name in old.namelist():
            body = old.read(name)
            if "DeviceSettings" in name:
                records = json.loads(body)
                records[0]["SubjectInfo"]["LeadTargets"] = ["Right M1", "", "Right STN", ""]
                body = json.dumps(records).encode()
            new.writestr(name, body)
    return sink.getvalue()


def test_the_control_channel_can_be_changed_on_the_proposal_with_its_reason_shown(
    client: TestClient, participant_code: str, send: Any, proposals: Callable[[], list[dict[str, Any]]]
) -> None:
    client.put(
        f"/api/v1/participants/{participant_code}/settings", json={"settings": {"beta_source": "time_domain", "cdbs_amplitude_ma": 4.0}}
    )
    send(("a.zip", on_cortex(device_zip())), visit=1)
    (proposal,) = proposals()
    session = proposal["session"]["id"]
    names = [(u["stream"], u["channel"]) for u in proposal["usable_steps"]]
    beta = [c for s, c in names if s == "beta"]
    assert "right STN" in proposal["evidence"]["control"] or len(beta) == 1
    stream, channel = next(n for n in names if n != ("beta", proposal["session"]["control_channel"]))
    wrong = {"version": 1, "control_stream": "beta", "control_channel": "key 9 +1-1"}
    refused = client.patch(f"/api/v1/proposals/{session}", json=wrong)
    assert (refused.status_code, "Choose one of" in refused.text) == (422, True)
    changed = client.patch(f"/api/v1/proposals/{session}", json={"version": 1, "control_stream": stream, "control_channel": channel})
    assert changed.status_code == 200, changed.text
    assert changed.json()["session"]["control_channel"] == channel
    assert changed.json()["evidence"]["control"].startswith("as stated by")
    (first, *_) = changed.json()["usable_steps"]
    assert (first["stream"], first["channel"], first["is_control"]) == (stream, channel, True)
    page = client.get(f"/proposals/{session}", headers={"Accept": "text/html"}).text
    assert f'value="{stream}|{channel}" selected' in page
    form = {f"version-{session}": "2", f"control-{session}": f"beta|{beta[0]}", f"seen-{session}": "{}", "do": "save"}
    posted = client.post(f"/participants/{participant_code}/proposals", data=form, follow_redirects=False)
    assert posted.status_code == 303, posted.text
    assert proposals()[0]["session"]["control_channel"] == beta[0]


@pytest.mark.parametrize("listed", [["+2-0", "+3-1", "", ""], ["+2-0", "", "", ""]])
def test_one_montage_for_the_whole_recording_is_no_survey(listed: list[str]) -> None:
    assert not is_survey(recording(contacts=[listed]))
