"""Feature extractors against each other over a folder of labelled images.

Every extractor runs in a process of its own and speaks one protocol (`protocol`), so that none can harm another or the
bench; what it reports is converted from its own conventions in one place (`conventions`). `run.bench_extractors` is the
whole; nothing is imported here, because every worker pays for it.
"""
