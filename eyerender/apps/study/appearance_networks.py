"""Networks that learn gaze from the pictures of one eye model, and their errors on those of all; needs PyTorch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ...base.arrays import Floats
from ...torch import Augment
from ...torch.gaze import angle_deg, answers, gaze_errors, read, trained

SIZE = 64  # width and height of the pictures that the networks see, px
COPIES, EPOCHS = 8, 3  # random changes of each picture, and how often a network sees each


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class NetworkErrors:
    """Mean errors of the people of a test, for networks that were trained on one set of pictures."""

    trained_on: str  # name of that set
    # by name of the tested set, (2, seeds, people) before and after nine points; nan where fewer than ten pictures of a
    # person show the gaze
    error_deg: Mapping[str, Floats]
    of_the_mean_deg: float  # mean error on that set's own test if the mean direction is stated every time
    # number of people and of pictures that the networks learnt from, before random changes
    people: int
    pictures: int


def errors_of_networks(folders: Mapping[str, Path], seeds: int, name: str) -> NetworkErrors:
    """Train a network per seed on the split `train` of one folder; test each on the split `test` of every folder.

    All folders show the same people. The random changes of the pictures are the same for every folder and seed.
    """
    with one_thread():
        torch.manual_seed(0)
        data = read([folders[name]], "train", size=SIZE, augment=Augment(flip=0.0), copies=COPIES)
        networks = [trained(data, EPOCHS, seed) for seed in range(seeds)]
        errors = {}
        for tested, folder in folders.items():
            test = read([folder], "test", size=SIZE)
            people, rows = np.unique(test["subject"].numpy(), return_inverse=True)
            each = np.array([gaze_errors(answers(network, test), test) for network in networks])
            errors[tested] = np.full((2, seeds, len(people)), np.nan)
            for k in range(len(people)):
                known = (rows == k) & np.isfinite(each).all(axis=(0, 1))
                if known.any():
                    errors[tested][:, :, k] = each[:, :, known].mean(axis=-1).T
            if tested == name:
                gaze = test["camera_gaze"].double().numpy()
                mean = np.nanmean(gaze, axis=0)
                straight = float(np.nanmean(angle_deg(mean / np.linalg.norm(mean), gaze)))
    return NetworkErrors(
        trained_on=name,
        error_deg=errors,
        of_the_mean_deg=straight,
        people=len(data["subject"].unique()),
        pictures=len(data["image"]) // COPIES,
    )


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on one thread with deterministic algorithms during the block, so that a run repeats to the bit."""
    threads, strict = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.use_deterministic_algorithms(strict)
