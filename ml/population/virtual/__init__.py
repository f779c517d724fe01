"""A virtual population: a distribution over patients at beta level (steps of 2 s), in three parts, with data, policies and true returns."""

from ml.population.virtual.candidates import InversePolicy, RelayPolicy, SmoothPolicy, draw_candidates
from ml.population.virtual.following import FollowingWorth, Worth, closed_loops, worth_of_following
from ml.population.virtual.patient import MECHANISMS, RATINGS, SHAPES, TREMORS, Patient, draw_patient
from ml.population.virtual.sessions import Days, Sessions, new_days, simulate, visit_days
from ml.population.virtual.traits import TRAITS, with_trait
from ml.population.virtual.world import (
    PARTS,
    WORLDS_PER_PART,
    DataDesign,
    Mean,
    Part,
    Population,
    Truth,
    World,
    is_responder,
    simple_policies,
    within_margins,
    world,
)

__all__ = [
    "MECHANISMS",
    "PARTS",
    "RATINGS",
    "SHAPES",
    "TRAITS",
    "TREMORS",
    "WORLDS_PER_PART",
    "DataDesign",
    "Days",
    "FollowingWorth",
    "InversePolicy",
    "Mean",
    "Part",
    "Patient",
    "Population",
    "RelayPolicy",
    "Sessions",
    "SmoothPolicy",
    "Truth",
    "World",
    "Worth",
    "closed_loops",
    "draw_candidates",
    "draw_patient",
    "is_responder",
    "new_days",
    "simple_policies",
    "simulate",
    "visit_days",
    "with_trait",
    "within_margins",
    "world",
    "worth_of_following",
]
