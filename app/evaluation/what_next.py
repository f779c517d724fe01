"""What to test next, in a few sentences: the first that the ranking and the participant's page say, made and kept once."""

from __future__ import annotations

from markupsafe import Markup

from app.evaluation import verdict_wording, wording
from app.evaluation.ranking.answer import OFF_SHARE
from app.evaluation.ranking.judged import Judged
from app.platform.web.templates import render_part
from app.study.margins import margins_of
from ml.ope import NEARLY_OFF


def what_next(judged: Judged, *, may_run: bool) -> Markup:
    """The sentences, as HTML.

    Args:
        judged: the ranking. may_run: whether who reads them may start jobs.
    """
    settings = judged.participant.current_settings
    minutes = judged.evaluation.horizon_steps * settings.period_s / 60

    def write() -> Markup:
        return render_part(
            "evaluation/_next.html",
            base=f"/participants/{judged.participant.code}",
            answer=judged.answer,
            drawn=judged.random_sessions(settings),
            minutes=round(minutes) if minutes >= 1 else round(minutes, 1),
            off_share=OFF_SHARE,
            nearly_off=NEARLY_OFF,
            margins=margins_of(judged.participant.margins_in_force),
            plainly=verdict_wording.plainly,
            effect=verdict_wording.effect,
            test_results=verdict_wording.test_results,
            random_effects=verdict_wording.random_effects,
            usual=verdict_wording.usual,
            allowed=verdict_wording.allowed,
            further=verdict_wording.further_sessions,
            amplitude=wording.amplitude,
            chance=wording.chance,
            outcome_names=wording.OUTCOME_NAMES,
            may_run=may_run,
        )

    return judged.kept(("next", judged.participant.code, settings.id, may_run), write)
