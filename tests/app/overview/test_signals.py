"""The samples of a session on the screen: what came, where it came, at the resolution that was asked for."""

from __future__ import annotations

import base64
import io
import json
import os
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image

from app.overview import samples_compute
from app.overview import signals as signals_rules
from app.overview.signals_web import POINTS, chart_figure
from app.platform.web.png import palette, picture
from ml.formats.recording import SampleLog
from tests.app.ingest.conftest import send, steady  # noqa: F401 (fixture)
from tests.app.overview.test_samples import lfp_table, session  # noqa: F401 (fixture)


def asked(client: TestClient, number: int, **params: Any) -> dict[str, Any]:
    answer = client.get(f"/api/v1/sessions/{number}/signal", params=params)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_a_short_stretch_has_every_sample_and_a_long_one_the_extremes_of_each_bin(client: TestClient, session: int) -> None:  # noqa: F811
    _, t, x = lfp_table()
    near = asked(client, session, begin_s=2.0, end_s=3.0, points=200)
    inside = (t >= 2.0) & (t <= 3.0)
    assert near["resolution_s"] == 0
    np.testing.assert_allclose(near["t_s"], t[inside], atol=1e-6)
    np.testing.assert_allclose(near["low"], x[inside], rtol=1e-5)
    assert near["high"] == near["low"]
    (channel,) = near["channels"]
    assert (channel["samples"], channel["unit"], channel["rates_hz"]) == (t.size, "uV", [250.0])

    far = asked(client, session, points=300)
    width = far["resolution_s"]
    assert 0 < width <= 40 / 300
    assert len(far["t_s"]) >= 300
    for middle, low, high in zip(far["t_s"], far["low"], far["high"], strict=True):
        here = x[(t >= middle - width / 2 - 1e-6) & (t < middle + width / 2 - 1e-6)]
        assert (low is None) == (here.size == 0)
        if here.size:
            assert (low, high) == (pytest.approx(here.min(), rel=1e-5), pytest.approx(here.max(), rel=1e-5))
    lost = [low for middle, low in zip(far["t_s"], far["low"], strict=True) if 8.1 < middle < 12.9]
    assert lost, "five seconds are missing"
    assert set(lost) == {None}


def test_the_spectrogram_stands_at_the_frequency_of_the_samples_and_is_empty_where_they_are_lost(client: TestClient, session: int) -> None:  # noqa: F811
    power = asked(client, session)["spectrogram"]
    for i, column in enumerate(power["decibel"]):
        begin = power["first_s"] + i * power["width_s"]
        if 8.1 < begin < 11.9:
            assert set(column) == {None}
        elif begin < 6.5 or begin > 13.5:
            assert power["hz"][int(np.argmax(column))] == 20.0


def test_its_files_are_read_once(client: TestClient, session: int, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    first = asked(client, session)

    def never(*_: object, **__: object) -> None:
        raise AssertionError("the files were read again")

    monkeypatch.setattr(signals_rules, "run_limited", never)
    assert asked(client, session) == first


def test_what_nobody_looked_at_for_long_is_forgotten_first(session: int, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    old, young = signals_rules._cache() / "old", signals_rules._cache() / "young"
    for folder, age in ((old, 3 * signals_rules.KEPT_S), (young, 60.0)):
        folder.mkdir()
        os.utime(folder, (time.time() - age, time.time() - age))
    monkeypatch.setattr(signals_rules, "KEPT", 1)
    asked(client, session)
    assert (old.exists(), young.exists()) == (False, True)


def test_a_window_or_a_channel_that_is_not_there_is_told_in_words(client: TestClient, session: int) -> None:  # noqa: F811
    outside = client.get(f"/api/v1/sessions/{session}/signal", params={"begin_s": 500, "end_s": 600})
    assert outside.status_code == 422
    assert "run from" in outside.json()["hint"]
    assert client.get(f"/api/v1/sessions/{session}/signal", params={"channel": 7}).status_code == 404


@pytest.mark.parametrize("end", ["begin_s", "end_s"])
def test_a_chart_has_the_bounds_of_the_api_and_a_page_takes_any_number_for_a_channel(client: TestClient, session: int, end: str) -> None:  # noqa: F811
    for value in ("inf", "-inf", "nan", "1e9"):
        assert client.get(f"/sessions/{session}/signal.json", params={end: value}).status_code == 422, value
    assert client.get(f"/sessions/{session}/signal", params={"channel": "9" * 5000}).status_code == 200


def test_two_who_ask_at_once_leave_one_folder(client: TestClient, session: int, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    build = signals_rules.run_limited

    def twice(*args: Any, **kwargs: Any) -> Any:
        monkeypatch.setattr(signals_rules, "run_limited", build)
        asked(client, session)  # another request is done first
        return build(*args, **kwargs)

    monkeypatch.setattr(signals_rules, "run_limited", twice)
    found = asked(client, session)
    (folder,) = signals_rules._cache().iterdir()
    assert [p for p in folder.iterdir() if p.is_dir()] == []
    assert found == asked(client, session)


def test_a_table_of_steps_has_no_samples_and_its_page_no_chart_of_them(send: Any, client: TestClient) -> None:  # noqa: F811
    number = send(("steps.csv", steady(1.0)), visit=1, controller="cdbs").json()["sessions"][0]["id"]
    answer = client.get(f"/api/v1/sessions/{number}/signal")
    assert (answer.status_code, "have no samples" in answer.json()["detail"]) == (409, True)
    assert "data-signal" not in client.get(f"/sessions/{number}").text


def test_the_page_draws_without_a_script_and_a_blinded_assessor_sees_nothing(client: TestClient, session: int, client_as: Any) -> None:  # noqa: F811
    assert f'data-signal="/sessions/{session}/signal.json"' in client.get(f"/sessions/{session}").text
    page = client.get(f"/sessions/{session}/signal", params={"begin_s": "2", "end_s": "4"})
    assert page.status_code == 200
    assert re.search(r'<path d="M[^"]{500,}"', page.text), "the samples are drawn"
    assert "data:image/png;base64," in page.text
    assert "every sample" in page.text
    empty = client.get(f"/sessions/{session}/signal", params={"begin_s": "900", "end_s": "950"})
    assert (empty.status_code, "There are no samples between 900 s and 950 s" in empty.text) == (422, True)
    chart = client.get(f"/sessions/{session}/signal.json").json()
    assert [t["type"] for t in chart["figure"]["data"]] == ["scatter", "heatmap"]
    blinded = client_as("blinded_assessor")
    for place in ("/api/v1/sessions/{}/signal", "/sessions/{}/signal", "/sessions/{}/signal.json"):
        assert blinded.get(place.format(session)).status_code == 403


def test_a_stretch_of_a_million_samples_is_drawn_fluidly(tmp_path: Path) -> None:
    """80 minutes at 250 Hz; processor time, which other work on the machine does not lengthen, by bounds ten times what it takes."""
    rate, n = 250.0, 1_200_000
    values = np.random.default_rng(4).standard_normal(n)
    values[600_123] = 50.0
    log = SampleLog.of("LFP", "uV", [(0.0, rate, values)])
    begun = time.process_time()
    header = samples_compute._written(log, tmp_path, 0)
    assert time.process_time() - begun < 2.0, "the pyramid and the spectrogram, once in a session's life"
    channel = signals_rules.SignalChannel(0, 1, None, "LFP", "uV", (rate,), n, header["begin_s"], header["end_s"])
    signals = signals_rules.Signals(tmp_path, (channel,), (json.loads(json.dumps(header)),))
    spike_s = 600_123 / rate
    for width in (4800.0, 600.0, 60.0, 8.0, 2.0):
        begin = max(0.0, spike_s - width / 2)
        begun = time.process_time()
        window = signals.window(0, begin, begin + width, POINTS)
        drawn = json.dumps(chart_figure(window, (begin, begin + width), 13.0, 30.0))
        assert time.process_time() - begun < 0.3, f"a window of {width} s"
        assert len(drawn) < 600_000
        assert window.t_s.size <= 5 * POINTS
        assert float(np.nanmax(window.high)) == 50.0, "no spike is lost at any width"


def test_a_picture_has_its_size_its_colours_and_nothing_where_nothing_is_known() -> None:
    values = np.array([[0.0, 1.0, np.nan], [2.0, -5.0, 9.0]])
    content = base64.b64decode(picture(values, 0.0, 2.0).removeprefix("data:image/png;base64,"))
    drawn = np.asarray(Image.open(io.BytesIO(content)).convert("RGBA"))
    first, last = [*palette()[0].tolist(), 255], [*palette()[-1].tolist(), 255]
    assert drawn.shape == (2, 3, 4)
    assert drawn[0, 0].tolist() == first == drawn[1, 1].tolist()
    assert drawn[0, 1].tolist() == [*palette()[127].tolist(), 255]
    assert drawn[0, 2, 3] == 0
    assert drawn[1, 0].tolist() == last == drawn[1, 2].tolist()
    assert palette()[0].tolist() == [24, 16, 66]
