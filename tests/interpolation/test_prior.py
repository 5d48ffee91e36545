"""The strand prior: codes and back, what the shipped weights reach on fresh strands, training that goes on, bad weights."""

from __future__ import annotations

import json

import numba
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from ct2hair_addon import training
from ct2hair_addon.errors import CT2HairError
from ct2hair_addon.interpolation import EuclideanCoder, LinearCoder, NetworkCoder, blend, chosen_coder, prior
from ct2hair_addon.interpolation.network import CODE, LEARNED, STEPS, StrandPrior, cosines
from ct2hair_addon.interpolation.procedural import KINDS, LONGEST, MOST_TURN, SHORTEST, procedural_strands
from ct2hair_addon.interpolation.train import TrainingPlan, start_linear, steps_of, train
from ct2hair_addon.interpolation.weights_file import FORMAT, VERSION, read_facts, save_weights
from ct2hair_addon.settings import InterpolationSettings, Settings


@pytest.fixture(scope="module")
def fresh():
    """Procedural strands of a seed that no training takes."""
    return procedural_strands(600, 424_242)


@pytest.fixture(scope="module")
def coder():
    return NetworkCoder.load()


@pytest.fixture(scope="module")
def learnable():
    made = procedural_strands(400, 5)
    return steps_of(made.shapes)


def helix(radius: float, pitch: float, length: float, phase: float = 0.0, points: int = 256) -> np.ndarray:
    """(1, points, 3) mm: a helix about the root's normal, the root at 0."""
    turn = np.hypot(pitch, 2.0 * np.pi * radius)
    angle = 2.0 * np.pi * np.linspace(0.0, length / turn, points) + phase
    line = np.stack([radius * np.cos(angle), radius * np.sin(angle), pitch * (angle - phase) / (2.0 * np.pi)], axis=1)
    return (line - line[0])[None].astype(np.float32)


class TestShippedWeights:
    def test_they_say_what_made_them(self):
        facts = read_facts(prior.WEIGHTS)
        assert {"recipe", "plan", "torch", "held_out"} <= facts.keys()
        assert facts["recipe"]["seed"] == facts["plan"]["seed"] == 0
        assert facts["plan"]["steps"] >= 500 and facts["recipe"]["styles"] >= 10_000
        assert facts["held_out"]["all"]["within"] >= 0.99
        assert prior.WEIGHTS.stat().st_size < 5e6

    def test_fresh_strands_come_back(self, coder, fresh):
        made = coder.decode(coder.encode(fresh.shapes))
        distance, angle = training.strand_errors(fresh.shapes, made)
        assert (distance <= training.TOLERANCE).mean() >= 0.985
        assert np.median(distance) * 200.0 < 0.06
        assert np.median(angle) < 1.0

    @pytest.mark.parametrize("length", [60.0, 150.0, 300.0])
    def test_curls_of_five_mm_radius_come_back(self, coder, length):
        truth = helix(5.0, 20.0, length)
        distance, angle = training.strand_errors(truth, coder.decode(coder.encode(truth)))
        assert distance[0] < training.TOLERANCE
        assert angle[0] < 5.0

    def test_shapes_in_and_out(self, coder, fresh):
        codes = coder.encode(fresh.shapes[:300, ::5])
        assert codes.shape == (300, CODE) and codes.dtype == np.float32
        made = coder.decode(codes)
        assert made.shape == (300, coder.points, 3) and made.dtype == np.float32
        np.testing.assert_array_equal(made[:, 0], 0.0)
        assert NetworkCoder.load(points=64).decode(codes[:2]).shape == (2, 64, 3)
        assert coder.decode(codes[:0]).shape == (0, coder.points, 3) and coder.encode(fresh.shapes[:0]).shape == (0, CODE)

    def test_a_code_gives_the_same_strand_twice_on_any_threads_and_in_any_company(self, coder, fresh):
        codes = coder.encode(fresh.shapes)
        made = coder.decode(codes)
        threads = numba.get_num_threads()
        try:
            numba.set_num_threads(1)
            np.testing.assert_array_equal(coder.encode(fresh.shapes), codes)
            np.testing.assert_array_equal(coder.decode(codes[:10]), made[:10])
        finally:
            numba.set_num_threads(threads)
        torch_threads = torch.get_num_threads()
        coder.decode(codes[:1])
        assert torch.get_num_threads() == torch_threads

    def test_blending_two_equal_codes_gives_the_strand(self, coder, fresh):
        codes = coder.encode(fresh.shapes[:8])
        pairs = np.stack([codes, codes], axis=1)
        mixed = coder.decode(blend(pairs, np.tile([0.3, 0.7], (8, 1)).astype(np.float32)))
        np.testing.assert_allclose(mixed, coder.decode(codes), atol=1e-3)

    def test_a_strand_of_no_length_is_refused(self, coder):
        with pytest.raises(CT2HairError, match="no length"):
            coder.encode(np.zeros((1, 256, 3), np.float32))


class TestProceduralStrands:
    def test_the_seed_makes_them(self):
        a, b, other = procedural_strands(60, 3), procedural_strands(60, 3), procedural_strands(60, 4)
        np.testing.assert_array_equal(a.shapes, b.shapes)
        assert not np.array_equal(a.shapes, other.shapes)

    def test_they_are_hair(self, fresh):
        moves = np.diff(fresh.shapes.astype(np.float64), axis=1)
        size = np.linalg.norm(moves, axis=2)
        length = size.sum(axis=1)
        assert length.min() > 0.98 * SHORTEST and length.max() < 1.02 * LONGEST
        moves /= size[:, :, None]
        turn = np.degrees(np.arccos(np.clip((moves[:, 1:] * moves[:, :-1]).sum(axis=2), -1.0, 1.0)))
        assert turn.max() < MOST_TURN + 0.1
        turns = training.turns(fresh.shapes)
        np.testing.assert_allclose(turns, turn.sum(axis=1) / 360.0, atol=1e-2)
        assert np.median(turns[fresh.kind == KINDS.index("rod")]) < 1.0
        assert np.percentile(turns[fresh.kind == KINDS.index("coil")], 90) > 8.0
        np.testing.assert_array_equal(fresh.shapes[:, 0], 0.0)

    def test_waves_swing_nearly_in_a_plane_and_coils_do_not(self):
        made = procedural_strands(600, 9)
        often = training.turns(made.shapes) > 5.0

        def flatness(kind: str) -> float:
            steps = np.diff(made.shapes[often & (made.kind == KINDS.index(kind))], axis=1)
            steps = steps - steps.mean(axis=1, keepdims=True)
            spread = np.linalg.svd(steps, compute_uv=False) ** 2
            return float(np.median(spread[:, 1] / spread.sum(axis=1)))

        assert flatness("wave") < 0.1 < 0.3 < flatness("coil")


class TestTraining:
    def test_it_sets_out_from_a_code_that_already_holds_the_strands(self, learnable):
        steps, length = map(torch.from_numpy, learnable)
        torch.manual_seed(0)
        network = StrandPrior()
        start_linear(network, steps, 0)
        with torch.no_grad():
            made = network.decode(network.encode(steps, length)[0])
        truth = np.concatenate([np.zeros((len(steps), 1, 3)), np.cumsum(learnable[0].transpose(0, 2, 1), axis=1)], axis=1)
        truth *= (learnable[1] / STEPS)[:, None, None]
        distance, _ = training.strand_errors(truth, made.numpy())
        assert np.median(distance) < training.TOLERANCE / 4.0

    def test_it_goes_on_bit_for_bit_where_it_was_cut_off(self, learnable, tmp_path):
        class CutOff(Exception):
            pass

        plan = TrainingPlan(steps=12, batch=16, rate=1e-4, seed=3)
        whole = train(*learnable, plan, tmp_path / "whole.pt").state_dict()
        state = tmp_path / "cut.pt"

        def cut(step: int, loss: float) -> None:
            if state.exists():
                raise CutOff

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("ct2hair_addon.interpolation.train.CHECKPOINT_SECONDS", 0.0)
            patch.setattr("ct2hair_addon.interpolation.train.REPORT_STEPS", 5)
            with pytest.raises(CutOff):
                train(*learnable, plan, state, cut)
        assert torch.load(state, weights_only=True)["step"] == 5
        resumed = train(*learnable, plan, state).state_dict()
        assert whole.keys() == resumed.keys()
        for name, value in whole.items():
            assert torch.equal(value, resumed[name]), name

    def test_it_lowers_the_loss(self, learnable, tmp_path):
        told: list[float] = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("ct2hair_addon.interpolation.train.REPORT_STEPS", 1)
            patch.setattr("ct2hair_addon.interpolation.train.start_linear", lambda *_: None)
            patch.setattr("ct2hair_addon.interpolation.train.WARM_UP", 1)
            train(*learnable, TrainingPlan(60, 64, 5e-3, 1.0), tmp_path / "s.pt", lambda step, loss: told.append(loss))
        assert np.mean(told[-5:]) < 0.5 * np.mean(told[:5])

    def test_a_state_of_another_plan_is_refused(self, learnable, tmp_path):
        train(*learnable, TrainingPlan(2, 8), tmp_path / "s.pt")
        with pytest.raises(CT2HairError, match="other settings"):
            train(*learnable, TrainingPlan(3, 8), tmp_path / "s.pt")

    def test_the_command_trains_and_writes_weights_that_load(self, tmp_path, monkeypatch, capsys):
        from ct2hair_addon import cli

        monkeypatch.setattr(training, "STYLES", ())
        out = tmp_path / "w.safetensors"
        command = ["train-prior", "--out", str(out), "--folder", str(tmp_path / "work"), "--steps", "3", "--batch", "8"]
        command += ["--styles", "0", "--single", "240", "--seed", "2"]
        assert cli.main(command) == cli.DONE
        assert "| coil |" in capsys.readouterr().out
        facts = read_facts(out)
        assert facts["plan"] == vars(TrainingPlan(3, 8, seed=2)) and facts["recipe"]["single"] == 240
        assert NetworkCoder.load(out).decode(np.zeros((1, CODE), np.float32)).shape == (1, 256, 3)

    def test_the_cosines_are_orthonormal(self):
        rows = cosines(40)
        np.testing.assert_allclose(rows @ rows.T, np.eye(40), atol=1e-5)


class TestWeightsThatWontDo:
    def test_missing_ones_are_named(self, tmp_path):
        with pytest.raises(CT2HairError, match=r"absent\.safetensors.*missing.*interpolation\.coder"):
            NetworkCoder.load(tmp_path / "absent.safetensors")

    @pytest.mark.parametrize("kept", [0, 7, 5000])
    def test_damaged_ones_are_named(self, tmp_path, kept):
        path = tmp_path / "w.safetensors"
        path.write_bytes(prior.WEIGHTS.read_bytes()[:kept])
        with pytest.raises(CT2HairError, match=r"w\.safetensors"):
            NetworkCoder.load(path)

    def test_another_version_is_refused(self, tmp_path):
        path = tmp_path / "w.safetensors"
        metadata = {"format": FORMAT, "version": str(VERSION + 1), "facts": json.dumps({})}
        save_file(load_file(prior.WEIGHTS), path, metadata)
        with pytest.raises(CT2HairError, match=f"version {VERSION + 1}, expected .* version {VERSION}"):
            NetworkCoder.load(path)

    def test_another_layout_is_refused(self, tmp_path):
        path = tmp_path / "w.safetensors"
        tensors = load_file(prior.WEIGHTS)
        tensors["decoder.mix"] = tensors["decoder.mix"][:-1].contiguous()
        save_file(tensors, path, {"format": FORMAT, "version": str(VERSION), "facts": "{}"})
        with pytest.raises(CT2HairError, match="don't fit"):
            NetworkCoder.load(path)

    def test_numbers_that_are_none_are_refused(self, tmp_path):
        network = StrandPrior()
        with torch.no_grad():
            network.decoder.mix[0, 0, 0] = float("nan")
        save_weights(network, tmp_path / "w.safetensors", {})
        with pytest.raises(CT2HairError, match="not all numbers"):
            NetworkCoder.load(tmp_path / "w.safetensors")

    def test_only_the_setting_lets_the_linear_coder_step_in(self, tmp_path, monkeypatch):
        monkeypatch.setattr(prior, "WEIGHTS", tmp_path / "absent.safetensors")
        with pytest.raises(CT2HairError, match="missing"):
            chosen_coder(InterpolationSettings())
        tally: dict[str, int] = {}
        lenient = Settings().changed({"interpolation.without_prior": "linear"})
        assert isinstance(chosen_coder(lenient.interpolation, tally), LinearCoder)
        assert sum(tally.values()) == 1

    @pytest.mark.parametrize(("name", "kind"), [("linear", LinearCoder), ("euclidean", EuclideanCoder)])
    def test_the_other_coders_need_no_weights(self, tmp_path, monkeypatch, name, kind):
        monkeypatch.setattr(prior, "WEIGHTS", tmp_path / "absent.safetensors")
        assert isinstance(chosen_coder(Settings().changed({"interpolation.coder": name}).interpolation), kind)


def test_the_learned_part_is_the_larger_part_of_a_code():
    assert LEARNED > CODE // 2
