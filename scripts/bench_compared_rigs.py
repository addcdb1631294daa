"""Do the intervals of two compared rigs hold the truth? Forty seeds of people before rigs whose difference is known.

Two pairs are compared: the headset and the same with one LED dimmed to a quarter; and the headset before right eyes and
its mirror image before left eyes, which is equal in truth, because left eyes are drawn as mirror images of right ones,
and not identical, because the two eyes of a person differ and slippage is not mirrored. The truth of the first pair is
the mean over the people of all seeds; it is known 40 times better, in variance, than the mean of one seed. That of the
second is 0. A correct interval of 95 % holds the truth in 35 seeds or fewer with a probability of 4.8 %.

    python scripts/bench_compared_rigs.py [--quick] [--people N] [--json F]
"""

from __future__ import annotations

import sys

import numpy as np

from _bench import Report, options_of, row, single_threaded

single_threaded()

import eyerender as er
from eyerender.apps.rigs.compare import compare_rigs
from eyerender.apps.rigs.options import RigSize

SEEDS, LEAST = 40, 36
PEOPLE = 50


def rigs() -> list[er.Scene]:
    """The headset, the headset with a dimmed LED, and its mirror image before left eyes."""
    plain = er.load_scene("headset")
    leds = plain.spec.rig.single_leds()
    # A ring before the left eye starts on the other side, so the LEDs are given one by one.
    plain = plain.with_({"rig.lights": leds}, name="headset")
    dimmed = [{**leds[0], "intensity_mw_sr": leds[0]["intensity_mw_sr"] / 4}, *leds[1:]]
    camera = plain.spec.to_mapping()["rig"]["cameras"][0]
    across = {key: [camera[key][0], -camera[key][1], camera[key][2]] for key in ("position_mm", "look_at_mm")}
    turned = [{**led, **{key: _mirrored(led[key]) for key in ("position_mm", "aim_mm")}} for led in leds]
    other = {"rig.cameras": [{**camera, **across}], "rig.lights": turned, "subject.eyes": ["left"]}
    return [plain, plain.with_({"rig.lights": dimmed}, name="dimmed"), plain.with_(other, name="mirrored")]


def _mirrored(point: list[float]) -> list[float]:
    return [point[0], -point[1], point[2]]


def main() -> int:
    """Compare both pairs for every seed, and count the intervals that hold the truth."""
    parser = options_of(__doc__, f"8 seeds in place of {SEEDS}, without bars")
    parser.add_argument("--people", type=int, default=PEOPLE, help="people of each seed")
    options = parser.parse_args()
    seeds, scenes, report = 8 if options.quick else SEEDS, rigs(), Report()
    must = None if options.quick else LEAST
    found: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    for seed in range(seeds):
        size = RigSize(people=options.people, sample=0, seed=seed, workers=1)
        for one in compare_rigs(scenes, er.Population("adults"), size)["comparisons"]:
            if one["rigs"][0] == "headset":
                interval = (one["difference"], one["low"], one["high"])
                found.setdefault((one["rigs"][1], one["quantity"]), []).append(interval)
        print(f"seed {seed} of {seeds}", file=sys.stderr, flush=True)
    for (other, quantity), values in found.items():
        difference, low, high = np.array(values, dtype=float).T
        truth = 0.0 if other == "mirrored" else float(difference.mean())
        held = int(((low <= truth) & (truth <= high)).sum())
        report.add(row(f"{other}, {quantity}: intervals that hold {truth:.3g}", held, "seeds", must, at_least=True))
        report.add(row(f"{other}, {quantity}: half width, median", float(np.median((high - low) / 2)), ""))
        error = float(difference.std(ddof=1) / np.sqrt(seeds))
        name = f"{other}, {quantity}: mean difference over its standard error"
        report.add(row(name, difference.mean() / max(error, 1e-300), ""))
    return report.finish(options.json, ("numpy", "scipy"))


if __name__ == "__main__":
    sys.exit(main())
