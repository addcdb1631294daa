"""What tests share: scenes, jobs, oracles, reference vectors, and processes that stop at a stage of their work."""
