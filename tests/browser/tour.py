"""Pages of the service by their names in docs/tour.md, and how their pictures are made: small enough to be kept in git."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

COLOURS = 64
WIDTH, HEIGHT = 1280, 860
MOST_BYTES = 120_000

PAGES = {
    "/": "study/today",
    "/energy-saved": "study/energy-saved",
    "/search": "study/search",
    "/adverse-events": "study/all-adverse-events",
    "/analyses": "study/all-analyses",
    "/trial-time": "study/trial-time",
    "/jobs": "study/all-jobs",
    "/audit": "study/audit",
    "/glossary": "study/glossary",
    "/sign-in": "study/sign-in",
    "/account": "study/account",
    "/accounts": "study/accounts",
    "/studies": "study/studies",
    "/api-reference": "study/rest-interface",
    "/styleguide": "study/style-guide",
    "/participants/new": "participant/new",
    "/participants/{code}": "participant/participant",
    "/participants/{code}/visits": "participant/visits",
    "/participants/{code}/visits/new": "participant/new-visit",
    "/participants/{code}/settings": "participant/settings",
    "/participants/{code}/characteristics": "participant/characteristics",
    "/participants/{code}/margins": "participant/margins",
    "/participants/{code}/adverse-events": "participant/adverse-events",
    "/participants/{code}/data-queries": "participant/data-queries",
    "/sessions/{session_id}": "participant/session",
    "/sessions/{session_id}/signal": "participant/signal",
    "/participants/{code}/upload": "collect/upload",
    "/uploads/{upload_id}": "collect/report",
    "/participants/{code}/proposals": "collect/proposals",
    "/proposals/{session_id}": "collect/proposal",
    "/sessions/{session_id}/markers": "collect/markers",
    "/participants/{code}/quarantine": "collect/quarantine",
    "/uploaded-files/{file_id}/mapping": "collect/mapping",
    "/studies/{study_code}/column-mappings": "collect/column-mappings",
    "/participants/{code}/device-history": "collect/device-history",
    "/participants/{code}/jobs": "learn/jobs",
    "/jobs/{job_id}": "learn/job",
    "/participants/{code}/policies": "learn/policies",
    "/sweeps/{sweep_id}": "learn/sweep",
    "/snapshots/{snapshot_id}": "learn/snapshot",
    "/participants/{code}/buffer-gate": "learn/buffer-gate",
    "/participants/{code}/next-generation": "learn/next-generation",
    "/participants/{code}/ranking": "evaluate/ranking",
    "/participants/{code}/policies/{policy_id}": "evaluate/policy",
    "/participants/{code}/compare": "evaluate/compare",
    "/participants/{code}/calibration": "evaluate/calibration",
    "/participants/{code}/plans": "plan/plans",
    "/visits/{visit_id}/plan": "plan/plan",
    "/visits/{visit_id}": "plan/visit",
    "/visits/{visit_id}/slots": "plan/slots",
    "/visits/{visit_id}/bundles": "plan/bundles",
    "/participants/{code}/policies/{policy_id}/bundle": "plan/bundle",
    "/participants/{code}/policies/{policy_id}/threshold-rule": "plan/threshold-rule",
    "/visit-day/{visit_id}": "plan/clinic-day",
    "/participants/{code}/analyses": "analyse/analyses",
    "/participants/{code}/analyses/visits/{key}": "analyse/visit-by-visit",
    "/participants/{code}/analyses/models/{key}": "analyse/models",
    "/participants/{code}/analyses/paper": "analyse/as-in-the-paper",
    "/participants/{code}/analyses/energy": "analyse/energy",
    "/participants/{code}/analyses/beta": "analyse/beta",
    "/participants/{code}/analyses/evaluations": "analyse/methods-by-seed",
}
"""Name of the picture of each page, by its route."""
PARTS = {"participant/session-samples": "#signal-card"}
"""Further pictures, of what is lower on the page of a session with `samples`: the card that is shown."""
OF_THE_RANKED = ("evaluate/ranking", "evaluate/policy", "evaluate/compare", "plan/plan", "plan/visit")
"""Made of a study with a judged ranking and a draft, in which there is more to see."""


def samples() -> bytes:
    """Build three minutes of samples at 250 Hz as a table: noise that falls with the frequency, and bursts of beta that stimulation
    shortens.
    """
    rng = np.random.default_rng(8)
    t = (np.arange(-20 * 250, 180 * 250) + 1) / 250
    white = np.fft.rfft(rng.standard_normal(t.size))
    pink = np.fft.irfft(white / np.sqrt(np.maximum(np.arange(white.size), 50)), t.size)
    bursts = np.clip(np.sin(2 * np.pi * t / 7) + 0.6 * np.sin(2 * np.pi * t / 3.1), 0, None) * np.where(t > 90, 0.4, 1.0)
    lfp = 6 * pink / pink.std() + 7 * bursts * np.sin(2 * np.pi * 21 * t)
    current = np.where(t > 90, 2.4, 1.2)
    rows = "".join(f"{a:.3f},{b:.2f},{ma}\n" for a, b, ma in zip(t, lfp, current, strict=True))
    return f"t_s,lfp [uV],amplitude_ma\n{rows}".encode()


def take(page: Any, folder: str | Path, name: str) -> None:
    """Take a picture of the upper part of the page, in few colours."""
    page.set_viewport_size({"width": WIDTH, "height": HEIGHT})
    page.wait_for_timeout(400)  # charts fit themselves to the window
    whole = Image.open(io.BytesIO(page.screenshot(scale="css"))).convert("RGB")
    path = Path(folder) / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    whole.quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
    assert path.stat().st_size <= MOST_BYTES, f"{name}: {path.stat().st_size} bytes"
