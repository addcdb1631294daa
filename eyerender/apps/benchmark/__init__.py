"""Comparison of feature extractors on a folder of labelled images.

Every extractor runs in its own process and uses one protocol (`protocol`), so that none can harm another or the
benchmark. `conventions` converts its results to this package's conventions, and `run.bench_extractors` runs everything.
This module imports nothing, because every worker would pay for it.
"""
