"""The result of fitting bright spots, as a batch."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ...base.arrays import Bools, Floats, Indices


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SpotFit:
    """A batch of fitted spots.

    Attributes:
        xy_px: (n, 2) centres.
        covariance: (n, 2, 2) of the centres, px^2.
        amplitude_dn: (n,) peak above the background.
        sigma_px: (n, 2) standard deviations along x and y.
        background_dn: (n,) level of the background at the centre.
        residual_dn: (n,) root mean square over the window.
        moments_px2: (n, 2, 2) second moments of the bright patch: those of the Gaussian if it explains the pixels, else
            those of the part above a third of the height, without background and other spots.
        clipped: (n,) number of clipped pixels.
        converged: (n,) whether the fit converged.
    """

    xy_px: Floats
    covariance: Floats
    amplitude_dn: Floats
    sigma_px: Floats
    background_dn: Floats
    residual_dn: Floats
    moments_px2: Floats
    clipped: Indices
    converged: Bools

    def taken(self, index: Indices) -> SpotFit:
        """Select the spots with these indices."""
        return SpotFit(**{one.name: getattr(self, one.name)[index] for one in fields(self)})

    def replaced(self, index: Indices, other: SpotFit) -> SpotFit:
        """Copy, with the spots at these indices replaced by those of `other`."""
        order = np.arange(self.converged.size)
        order[index] = order.size + np.arange(index.size)
        return joined([self, other]).taken(order)


def joined(parts: list[SpotFit]) -> SpotFit:
    """Concatenate several batches."""
    return SpotFit(**{one.name: np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(SpotFit)})
