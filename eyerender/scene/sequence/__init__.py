"""Eyes, lids, pupils, head and rig as functions of time."""
