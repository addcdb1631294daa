"""Dataset runs: from a spec to a labelled dataset, on one machine or many.

`spec` and `plan` define sample i, `maker` makes it, `shard` and `run` write it, `validate` and `export` read it.
"""
