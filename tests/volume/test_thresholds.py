"""Thresholds: air and noise of drawn histograms, a lone strand's level of drawn peaks, and both on small synthetic scans."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.errors import ScanError
from ct2hair_addon.evaluation import strand_peak, synthesize
from ct2hair_addon.settings import ScanSettings
from ct2hair_addon.volume import find_thresholds, open_scan
from ct2hair_addon.volume.structure import LINE_SHARE
from ct2hair_addon.volume.thresholds import HAIR_SHARE, KNOT_SHARE, air_and_noise, strand_level


def histogram(noise: float, whole: bool, padding: int, seed: int) -> np.ndarray:
    """200,000 values of air at 1000, a tail of hair over it, and a constant filling at -2000."""
    generator = np.random.default_rng(seed)
    values = generator.normal(1000.0, noise, 200_000)
    values[:30_000] += generator.exponential(90.0, 30_000)
    values = np.rint(values) if whole else values
    return generator.permutation(np.concatenate([values, np.full(padding, -2000.0)]))


@pytest.mark.parametrize("noise", [8.0, 32.0, 65.0])
@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.parametrize("padding", [0, 60_000, 300_000])
def test_air_and_noise_are_the_gaussians_whatever_lies_over_it_and_beside_it(noise, whole, padding):
    air, found = air_and_noise(histogram(noise, whole, padding, 1))
    assert air == pytest.approx(1000.0, abs=0.12 * noise)
    assert found == pytest.approx(noise, rel=0.08)


def test_a_scan_without_noise_has_none():
    values = np.full(100_000, 7.0)
    assert air_and_noise(values) == (7.0, 0.0)
    values[:20_000] += np.random.default_rng(0).exponential(90.0, 20_000)
    air, noise = air_and_noise(values)
    assert air == pytest.approx(7.0, abs=0.5) and noise < 1e-4


def test_the_lowest_pile_of_lines_is_a_lone_strands():
    generator = np.random.default_rng(3)
    piles = [(4000, 100.0), (3000, 200.0), (1500, 310.0)]
    height = np.concatenate([level * np.exp(generator.normal(0, 0.08, count)) for count, level in piles])
    peaks = np.stack([LINE_SHARE * height, np.zeros(len(height))], axis=1)
    line = np.full((len(height), 2), (1, 70))
    strand, lines, share = strand_level(peaks, line)
    assert strand == pytest.approx(100.0, rel=0.06)
    assert lines == len(height) and share == 1.0
    # as many sheets of another height change the share and nothing else
    sheet = np.full((len(height), 2), (9, 90))
    strand, lines, share = strand_level(np.concatenate([peaks, 0.3 * peaks]), np.concatenate([line, sheet]))
    assert strand == pytest.approx(100.0, rel=0.06) and lines == len(height) and share == 0.5
    # blobs are neither
    assert strand_level(peaks, np.full((len(height), 2), (0, 10)))[:2] == (0.0, 0)


@pytest.mark.parametrize("alone, spread", [(0.04, 0.18), (0.1, 0.1)], ids=["a few, noisy", "more"])
def test_the_few_lone_strands_beside_a_braid_are_the_level(alone, spread):
    generator = np.random.default_rng(8)
    bundles = np.exp(generator.normal(np.log(9.0), 0.5, 7000))
    lone = np.exp(generator.normal(0.0, spread, int(7000 * alone)))
    height = np.concatenate([bundles[bundles > 1.8], lone])
    peaks = np.stack([100.0 * LINE_SHARE * height, np.zeros(len(height))], axis=1).astype(np.float32)
    line = np.full((len(height), 2), (1, 10), np.int16)
    assert strand_level(peaks, line)[0] == pytest.approx(100.0, rel=0.15)
    # a scatter of faint ones is no pile, nor is the foot of a heap: where that begins is nearest to a lone strand's
    few = np.concatenate(
        [np.arange(len(lone))[: len(lone) // 8] + int((bundles > 1.8).sum()), np.arange((bundles > 1.8).sum())]
    )
    assert 100.0 < strand_level(peaks[few], line[few])[0] < 300.0


@pytest.mark.parametrize(("lines", "bundle"), [(600, 13.0), (1600, 6.0), (7500, 4.5)])
def test_where_bundles_hide_the_lone_strands_pile_in_noise_the_faintest_lines_tell(lines, bundle):
    generator = np.random.default_rng(2)
    # from one strand to many without a gap, as in a braid at half the signal, and a few lines of noise
    strands = np.exp(generator.normal(np.log(bundle), 0.55, lines))
    strands[: lines // 25] = np.exp(generator.uniform(0.0, np.log(1.8), lines // 25))
    height = np.concatenate([strands[strands > 1.0] + generator.normal(0.0, 0.18, (strands > 1.0).sum()), [0.5, 0.55, 0.6]])
    peaks = np.stack([100.0 * LINE_SHARE * height, np.zeros(len(height))], axis=1).astype(np.float32)
    assert strand_level(peaks, np.full((len(height), 2), (1, 10), np.int16))[0] == pytest.approx(100.0, rel=0.35)


@pytest.fixture(scope="module")
def scan_of(ball, spikes, tmp_path_factory):
    """How a scan of the spikes on the ball is made, each once."""
    made = {}

    def make(**changes):
        key = tuple(sorted(changes.items()))
        if key not in made:
            path = tmp_path_factory.mktemp("scan") / "scan.nrrd"
            synthesize(spikes, ball, path, 0.6, seed=4, **changes)
            made[key] = path
        return made[key]

    return make


def found(path, **settings):
    with open_scan(path) as reader:
        return find_thresholds(reader, ScanSettings(**settings))


@pytest.mark.parametrize(("snr", "tolerance"), [(2.0, 0.25), (4.0, 0.12), (10.0, 0.1)])
def test_a_strand_of_130_over_air_of_1000_is_found_in_noise(snr, tolerance, scan_of):
    levels = found(scan_of(snr=snr, mannequin="none", net=False))
    noise = 130.0 / snr
    assert levels.air == pytest.approx(1000.0, abs=0.1 * noise)
    assert levels.noise == pytest.approx(noise, rel=0.08)
    assert levels.strand == pytest.approx(130.0, rel=tolerance)
    assert levels.hair == pytest.approx(levels.air + HAIR_SHARE * levels.strand)
    assert levels.knots == pytest.approx(levels.air + KNOT_SHARE * levels.strand)
    assert levels.solid is None and levels.chosen == () and levels.lines > 500


def test_a_clean_scan_has_no_noise_and_a_strands_own_peak(scan_of):
    levels = found(scan_of(clean=True))
    assert levels.air == pytest.approx(0.0, abs=1e-3) and levels.noise < 1e-4
    assert levels.strand == pytest.approx(strand_peak(0.85), rel=0.12)


@pytest.mark.parametrize(("mannequin", "level", "lowest"), [("shell", 12.0, 0.3), ("solid", 12.0, 0.4), ("solid", 8.0, 0.4)])
def test_the_mannequin_lies_above_half_its_material_and_hair_is_found_beside_it(mannequin, level, lowest, scan_of):
    levels = found(scan_of(snr=4.0, mannequin=mannequin, mannequin_level=level))
    assert levels.strand == pytest.approx(130.0, rel=0.2)
    assert levels.air == pytest.approx(1000.0, abs=10.0)
    material = 130.0 * level
    assert lowest * material < levels.solid - levels.air < 0.65 * material


def test_foam_near_air_is_no_mannequin_and_hides_no_hair(scan_of):
    levels = found(scan_of(snr=4.0, mannequin="foam"))
    assert levels.solid is None
    assert levels.strand == pytest.approx(130.0, rel=0.2)
    assert levels.air == pytest.approx(1000.0, abs=12.0)


def test_settings_overrule_what_is_found(scan_of):
    path = scan_of(snr=4.0, mannequin="none", net=False)
    levels = found(path, air=990.0, hair=1100.0, knots=1500.0, solid=3000.0)
    assert (levels.air, levels.hair, levels.knots, levels.solid) == (990.0, 1100.0, 1500.0, 3000.0)
    assert levels.chosen == ("air", "hair", "knots", "solid")
    with pytest.raises(ScanError, match=r"scan\.hair is 500, not above air .*set it higher"):
        found(path, hair=500.0)


def nothing(kind: str, folder):
    """Scans without hair, 60 mm wide: noise; a block of material; flat; a ball with a rough surface."""
    generator = np.random.default_rng(5)
    values = np.full((100, 100, 100), 1000.0)
    if kind != "flat":
        values += generator.normal(0, 30.0, values.shape)
    if kind == "block":
        values[20:80, 20:80, 20:80] += 2000.0
    if kind == "blobs":
        values[tuple(generator.integers(2, 98, (3, 4000)))] += 3000.0
    np.save(folder / "nothing.npy", np.rint(values).astype(np.uint16))
    return folder / "nothing.npy"


@pytest.mark.parametrize("kind", ["noise", "flat", "block", "blobs"])
def test_a_scan_without_hair_is_refused_and_said_what_was_looked_for(kind, tmp_path):
    with open_scan(nothing(kind, tmp_path), ScanSettings(spacing=0.6)) as reader:
        with pytest.raises(ScanError) as caught:
            find_thresholds(reader, ScanSettings())
    text = str(caught.value)
    assert "nothing.npy: no hair was found. Looked for strands, lines a voxel or two wide" in text
    assert "expected at least 4 m" in text and "scan.spacing" in text and "set scan.hair" in text


def test_a_hair_level_by_hand_is_taken_where_no_hair_is_found(tmp_path):
    with open_scan(nothing("noise", tmp_path), ScanSettings(spacing=0.6)) as reader:
        levels = find_thresholds(reader, ScanSettings(hair=1080.0))
    assert levels.hair == 1080.0 and levels.strand == pytest.approx((1080.0 - levels.air) / HAIR_SHARE)


def test_progress_runs_from_0_to_1(scan_of):
    told = []
    with open_scan(scan_of(snr=4.0, mannequin="none", net=False)) as reader:
        find_thresholds(reader, ScanSettings(), lambda done, total: told.append(done / total))
    assert told[-1] == 1.0 and np.all(np.diff(told) > -1e-9)
