"""People: a joint distribution of eyes, pupils, lids and faces, and persons drawn from it."""
