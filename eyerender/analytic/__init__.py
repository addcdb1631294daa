"""The analytic observer: features of eyes by ray optics."""
