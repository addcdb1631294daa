"""Products built from the package: benchmark, studies, inspection, realism, rigs, sweeps, surveys, quickstart, live."""
