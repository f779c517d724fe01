"""REST routes of controller bundles."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query, Response
from fastapi.responses import PlainTextResponse

from app.accounts.deps import CurrentCaller
from app.learning.deps import CurrentPolicy
from app.planning.bundles import service as bundles
from app.planning.bundles import slots
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.deps import CurrentVisit
from app.tables.participants import Hemisphere, Participant

router = APIRouter(tags=["learning"], responses=problems(401, 403, 404, 422))

Milliamperes = Annotated[float | None, Query(ge=0, le=25.5, allow_inf_nan=False)]


@router.get(
    "/policies/{policy_id}/bundle",
    response_class=Response,
    responses=problems(409) | {200: {"content": {"application/zip": {}}, "description": "The controller bundle."}},
)
def read_bundle(
    policy: CurrentPolicy,
    db: Db,
    caller: CurrentCaller,
    min_ma: Annotated[Milliamperes, Query(description="Lowest amplitude, mA; the stimulator's own limit, or 0, where not given.")] = None,
    max_ma: Annotated[Milliamperes, Query(description="Highest amplitude, mA; the cDBS amplitude where not given.")] = None,
    ramp_ma_per_s: Annotated[float | None, Query(gt=0, le=100, allow_inf_nan=False, description="Fastest change, mA/s.")] = None,
    hemisphere: Annotated[Hemisphere | None, Query(description="Needed where a visit states several cDBS amplitudes.")] = None,
) -> Response:
    """The signed controller bundle as a ZIP: network, C header, reference runner, test vectors, the clinician's limits, a sheet.

    It is stored when it is first taken; who takes the same again gets the same bytes, with the name of who took it first. The audit trail
    says of each time who took it, for whom and within which limits.
    """
    participant = db.get_one(Participant, policy.participant_id)
    content = bundles.bundle(db, participant, policy, bundles.Limits(min_ma, max_ma, ramp_ma_per_s), hemisphere, caller)
    name = f"{participant.code}-policy-{policy.id}.zip"
    return Response(content, media_type="application/zip", headers={"Content-Disposition": f'attachment; filename="{name}"'})


@router.get(
    "/visits/{visit_id}/plan/sessions/{position}/bundle",
    response_class=Response,
    responses=problems(409) | {200: {"content": {"application/zip": {}}, "description": "The session's bundle."}},
)
def read_session_bundle(
    visit: CurrentVisit, db: Db, caller: CurrentCaller, position: Annotated[int, Path(ge=1, le=1000, description="Of the session.")]
) -> Response:
    """The signed bundle of one session of the visit's signed plan: it runs on the day of the visit, once.

    Sessions of policies hold the network, random and cDBS sessions their schedule. A plan that is not signed, was changed since, or holds
    a withdrawn policy has none; nor has one with a policy under which something serious happened since, until a clinician clears it. It
    is stored when it is first taken; later it is the same bytes, and the audit trail has each time.
    """
    name, content = slots.bundle(db, visit, position, caller)
    return Response(content, media_type="application/zip", headers={"Content-Disposition": f'attachment; filename="{name}"'})


@router.get("/bundle-withdrawals", response_class=PlainTextResponse)
def read_withdrawals(db: Db, caller: CurrentCaller) -> PlainTextResponse:
    """Policies and plans that were withdrawn, signed: bring it to the tablet, which then refuses their bundles.

    Plans that may not run after a serious adverse event are among them, until a clinician has cleared it.
    """
    return PlainTextResponse(slots.withdrawals(db))


@router.get("/bundle-key", response_class=PlainTextResponse)
def read_bundle_key(caller: CurrentCaller) -> str:
    """The public key that this installation's bundles are signed with: 64 hexadecimal digits. Give it to a tablet once."""
    return bundles.public_key() + "\n"
