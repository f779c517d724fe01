"""Who may open each page and send each form: the permission that it needs, and what is open to a blinded assessor."""

from __future__ import annotations

from app.accounts import permissions as can

FORMS = {
    "/studies": can.MANAGE_ACCOUNTS,
    "/studies/{study_code}/sites": can.MANAGE_ACCOUNTS,
    "/studies/{study_code}/members": can.MANAGE_ACCOUNTS,
    "/studies/{study_code}/members/end": can.MANAGE_ACCOUNTS,
    "/accounts": can.MANAGE_ACCOUNTS,
    "/accounts/{user_id}/password": can.MANAGE_ACCOUNTS,
    "/accounts/{user_id}/active": can.MANAGE_ACCOUNTS,
    "/participants": can.WRITE_STUDY,
    "/participants/{code}/settings": can.WRITE_SETTINGS,
    "/participants/{code}/margins": can.APPROVE_PLAN,
    "/participants/{code}/margins/lock": can.APPROVE_PLAN,
    "/participants/{code}/characteristics": can.WRITE_STUDY,
    "/participants/{code}/adverse-events": can.WRITE_STUDY,
    "/adverse-events/{event_id}/correction": can.WRITE_STUDY,
    "/adverse-events/{event_id}/clearance": can.APPROVE_PLAN,
    "/participants/{code}/data-queries": can.ASK_QUERIES,
    "/data-queries/{query_id}/entries": can.WRITE_STUDY,
    "/participants/{code}/visits": can.WRITE_STUDY,
    "/visits/{visit_id}": can.WRITE_STUDY,
    "/visits/{visit_id}/lock": can.LOCK_VISIT,
    "/visits/{visit_id}/doses": can.WRITE_STUDY,
    "/doses/{dose_id}/removal": can.WRITE_STUDY,
    "/sessions/{session_id}/qoc": can.WRITE_QOC,
    "/sessions/{session_id}/correction": can.WRITE_STUDY,
    "/sessions/{session_id}/conditions": can.WRITE_STUDY,
    "/sessions/{session_id}/derived": can.WRITE_QOC,
    "/sessions/{session_id}/exclusion": can.WRITE_STUDY,
    "/participants/{code}/upload": can.UPLOAD,
    "/participants/{code}/proposals": can.WRITE_STUDY,
    "/uploaded-files/{file_id}/session": can.WRITE_STUDY,
    "/uploaded-files/{file_id}/decision": can.DECIDE_QUARANTINE,
    "/uploaded-files/{file_id}/mapping": can.UPLOAD,
    "/column-mappings/{mapping_id}/remove": can.UPLOAD,
    "/participants/{code}/policies": can.WRITE_POLICIES,
    "/participants/{code}/policies/{policy_id}/bundle": can.TAKE_BUNDLES,
    "/participants/{code}/policies/{policy_id}/release": can.APPROVE_PLAN,
    "/participants/{code}/policies/{policy_id}/retire": can.WRITE_POLICIES,
    "/participants/{code}/buffer-gate": can.APPROVE_PLAN,
    "/participants/{code}/jobs": can.RUN_JOBS,
    "/participants/{code}/next-generation": can.RUN_JOBS,
    "/jobs/{job_id}/cancel": can.RUN_JOBS,
    "/jobs/{job_id}/retry": can.RUN_JOBS,
    "/visits/{visit_id}/plan/approve": can.APPROVE_PLAN,
    "/visits/{visit_id}/plan": can.DRAFT_PLAN,
    "/participants/{code}/plan/draft": can.DRAFT_PLAN,
    "/visits/{visit_id}/plan/move": can.DRAFT_PLAN,
    "/visits/{visit_id}/plan/key": can.APPROVE_PLAN,
    "/visits/{visit_id}/remove": can.WRITE_STUDY,
    "/visit-day/{visit_id}": can.WRITE_QOC,
    "/visits/{visit_id}/slots/confirm": can.WRITE_STUDY,
    "/participants/{code}/status": can.WRITE_STUDY,
}
"""Forms about a study, in the order in which they are sent: what one takes away, those before it had."""
OWN_FORMS = (
    "/account/tokens",
    "/account/tokens/{token_id}/revoke",
    "/account/second-factor",
    "/account/second-factor/confirm",
    "/account/second-factor/remove",
    "/account/password",
    "/sign-out",
)
"""Forms about one's own access, open to everybody who has signed in."""
BEFORE_SIGN_IN = ("/sign-in",)
RESTRICTED = {
    # pages that need more than to read
    "/studies": can.MANAGE_ACCOUNTS,
    "/accounts": can.MANAGE_ACCOUNTS,
    "/audit": can.READ_AUDIT,
    "/participants/new": can.WRITE_STUDY,
    "/participants/{code}/visits/new": can.WRITE_STUDY,
    "/participants/{code}/upload": can.UPLOAD,
    "/uploaded-files/{file_id}/mapping": can.UPLOAD,
    "/participants/{code}/next-generation": can.RUN_JOBS,
}
BLINDED_FORMS = {"/sessions/{session_id}/qoc", "/visit-day/{visit_id}"}
BLINDED_PAGES = {
    "/", "/account", "/participants/{code}", "/participants/{code}/visits", "/visits/{visit_id}", "/visit-day/{visit_id}", "/visit-day/key",
    "/analyses", "/analyses/figure", "/analyses/results.csv", "/analyses/results.svg",
    "/participants/{code}/analyses",
    "/participants/{code}/analyses/paper", "/participants/{code}/analyses/paper.csv", "/participants/{code}/analyses/paper.svg",
    "/participants/{code}/analyses/energy", "/participants/{code}/analyses/energy.csv",
    "/participants/{code}/analyses/beta", "/trial-time", "/glossary", "/energy-saved", "/api-reference",
}  # fmt: skip
"""While no visit is locked; what they show goes through `app.study.blinding`. Pages of one session or comparison open with the lock."""
WITHOUT_SIGN_IN = {"/sign-in", "/visit-day/shell", "/visit-day/worker.js"}
