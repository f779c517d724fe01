"""The plain form of the paper (section 5, Algorithm 1): what of betaloop's own is off in it, checked on what it computes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from ml.ope.dlsm.batches import make_batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.estimator import Dlsm
from ml.ope.dlsm.networks import DlsmNetworks
from ml.ope.dlsm.training import MemberTraining
from ml.ope.registry import build
from ml.ope.scale import learn_scale
from ml.policies.policy import ConstantPolicy
from ml.trajectories import ReplayBuffer

TINY: dict[str, Any] = {
    "latent": 2, "hidden": 4, "heads": (4,), "members": 2, "steps": 15, "batch": 4, "check_every": 5, "rollouts": 12, "replay_draws": 3,
}  # fmt: skip
PAPER = replace(DlsmConfig.paper("demo"), **TINY)


def test_the_settings_are_those_of_the_papers_section_5_and_algorithm_1() -> None:
    c = DlsmConfig.paper("full", 3)
    assert c.objective == "posterior"  # the bound of theorem 5.1, nothing weighed
    assert (c.state_terms, c.decode_all_window) == ("window", True)  # p(s_t | z_t) of the whole state, drawn again
    assert (c.action_emission, c.skip) == (False, False)  # s_t and r_{t-1} given z_t alone, z_t given h_t alone
    assert (c.end_features, c.end_source, c.qoc_terms) == ("final", "latent", False)  # r_end given z_T
    assert (c.start, c.reward_source, c.keep) == ("prior", "head", "last")
    assert (c.members, c.seed) == (DlsmConfig().members, 3)


def test_the_key_builds_the_plain_form_at_every_size() -> None:
    for size in ("full", "demo"):
        built = build("dlsm_paper", 3, size)  # type: ignore[arg-type]
        assert isinstance(built, Dlsm)
        assert (built.method, built.config) == ("dlsm_paper", DlsmConfig.paper(size, 3))  # type: ignore[arg-type]


def test_z_is_drawn_given_the_recurrent_state_alone_and_stays_so(small_buffer: ReplayBuffer) -> None:
    scale = learn_scale(small_buffer)
    training = MemberTraining(small_buffer, make_batch(small_buffer, scale), scale, [0, 5], PAPER, 7, "")
    training.run()
    for part in (training.networks.encoder, training.networks.decoder):
        assert float(part.a_x.abs().sum() + part.a_z.abs().sum()) == 0.0
        z, h, c = torch.ones(1, 2), torch.zeros(1, 4), torch.full((1, 4), -50.0)
        # with the output gate shut, h is 0, so that neither z_{t-1} nor the inputs can reach z_t but by a path past h
        with torch.no_grad():
            part.bias[12:] = -1e3
            drawn = [part.step(torch.full((1, part.w_x.shape[0]), x), z * x, h, c, torch.zeros(1, 2))[0] for x in (0.0, 1.0)]
        torch.testing.assert_close(drawn[0], drawn[1])


def test_the_qocs_are_read_from_the_latent_state_and_do_not_shape_it(small_buffer: ReplayBuffer) -> None:
    batch = make_batch(small_buffer, learn_scale(small_buffer), torch.float64)
    garbled = batch.outcomes.clone()
    garbled[:, 1:] += 3.0
    net = DlsmNetworks(10, PAPER).double()
    noise = net.noise(*batch.size, torch.Generator().manual_seed(2))
    latent = [p for name, p in net.named_parameters() if p.requires_grad and not name.startswith(("outcome", "reward"))]

    def gradients(outcomes: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return torch.autograd.grad(net.loss(replace(batch, outcomes=outcomes), noise), [*latent, net.outcome.affine.weight])

    plain, moved = gradients(batch.outcomes), gradients(garbled)
    for a, b in zip(plain[:-1], moved[:-1], strict=True):
        torch.testing.assert_close(a, b)
    assert float((plain[-1][1:4] - moved[-1][1:4]).abs().max()) > 1e-3
    of_r_end = gradients(batch.outcomes + torch.eye(4, dtype=torch.float64)[0])
    assert max(float((a - b).abs().max()) for a, b in zip(plain[:-1], of_r_end[:-1], strict=True)) > 1e-3


@pytest.mark.parametrize(("keep", "kept"), [("last", 15), ("best", 5)])
def test_it_ends_at_the_last_step_whatever_the_held_out_checks_say(small_buffer: ReplayBuffer, keep: Any, kept: int) -> None:
    scale = learn_scale(small_buffer)
    config = replace(PAPER, keep=keep, patience=2)
    training = MemberTraining(small_buffer, make_batch(small_buffer, scale), scale, [0, 5], config, 7, "")
    scored, worse = training.score, iter((1.0, 2.0, 3.0))

    def worsening(*given: Any) -> Any:
        return replace(scored(*given), score=next(worse))

    training.score = worsening  # type: ignore[method-assign]
    member = training.run()
    assert member.course[-1][0] == 15
    assert member.check.score == {5: 1.0, 15: 3.0}[kept]


def test_an_estimate_is_that_of_roll_outs_from_the_prior_with_the_reward_head(small_buffer: ReplayBuffer) -> None:
    estimate = Dlsm(PAPER, "dlsm_paper").fit(small_buffer).evaluate({"half": ConstantPolicy(0.5)}, 20)["half"]
    assert estimate.method == "dlsm_paper"
    assert {k: estimate.details[k] for k in ("start", "reward_source", "end_source", "objective")} == {
        "start": "prior", "reward_source": "head", "end_source": "latent", "objective": "posterior",
    }  # fmt: skip
    assert estimate.step_return == pytest.approx(estimate.details["step_return_head"])
