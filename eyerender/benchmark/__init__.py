"""Comparison of feature extractors over a folder of labelled images.

Every extractor runs in a process of its own and uses one protocol (`protocol`), so that none can harm another or the
bench. What it reports is converted from its own conventions in one place (`conventions`). `run.bench_extractors` runs
everything. Nothing is imported here, because every worker would pay for it.
"""
