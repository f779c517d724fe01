"""Charts of the ranking."""

from __future__ import annotations

from app.evaluation.schemas import RankedPolicy, RankingOut
from app.platform.numbers import counted
from app.platform.web.charts import Chart, axis, figure
from ml.ope import shown


def style(method: str) -> dict[str, str]:
    """Return colour and symbol of a method's marks."""
    found = shown(method)
    return {"color": f"token:{found.colour}", "symbol": found.symbol}


def shown_references(ranking: RankingOut) -> list[RankedPolicy]:
    """Select references for the page: cDBS, the best constant, proportional control, the behaviour clone; the API has every constant."""
    return [p for p in ranking.references if p.reference != "constant"]


def label(policy: RankedPolicy) -> str:
    """Return a policy's name in the ranking's charts and tables."""
    names = {
        "cdbs": "cDBS (reference)",
        "best_constant": f"best constant: {policy.name}",
        "proportional": "proportional (reference)",
        "cloning": "behaviour clone (reference)",
    }
    return names.get(policy.reference or "", policy.name)


def forest(ranking: RankingOut) -> Chart:
    """Estimate and interval of every policy, best on top; the ranking's method is shown, the others wait in the legend."""
    listed = [*ranking.policies, *shown_references(ranking)]
    data = []
    for method in sorted(ranking.methods, key=lambda m: m != ranking.default_method):
        have = [p for p in listed if method in p.estimates]
        estimates = [p.estimates[method] for p in have]
        marks = style(method)
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": shown(method).short,
                "visible": True if method == ranking.default_method else "legendonly",
                "x": [e.value for e in estimates],
                "y": [label(p) for p in have],
                "marker": {
                    "size": 10,
                    "color": marks["color"],
                    "symbol": [marks["symbol"] + ("" if e.supported else "-open") for e in estimates],
                },
                "error_x": {
                    "type": "data",
                    "symmetric": False,
                    "array": [e.high - e.value for e in estimates],
                    "arrayminus": [e.value - e.low for e in estimates],
                    "color": marks["color"],
                },
                "hovertemplate": "%{y}: %{x:.2f}<extra>" + shown(method).name + "</extra>",
            }
        )
    level = next((e.level for p in listed for e in p.estimates.values()), 0.9)
    rows = [
        [label(p), p.rank, shown(m).name, e.value, e.low, e.high, "yes" if e.supported else "no"]
        for p in listed
        for m, e in p.estimates.items()
    ]
    return Chart(
        id="forest",
        title="Estimated return",
        subtitle=f"E[r_end + discounted step rewards over {ranking.horizon_steps} steps], {100 * level:.0f} % intervals · "
        f"n = {counted(ranking.snapshot.sessions, 'session')} · open marks: not supported by the data",
        figure=figure(
            data,
            xaxis=axis("Estimated return", "reward"),
            yaxis=axis("", categoryorder="array", categoryarray=[label(p) for p in reversed(listed)], dtick=1),
            margin={"l": 150, "r": 16, "t": 12, "b": 44},
        ),
        columns=["Policy", "Rank", "Method", "Value (reward)", f"Low ({100 * level:.0f} %)", f"High ({100 * level:.0f} %)", "Supported"],
        rows=rows,
        height=140 + 30 * len(listed),
    )
