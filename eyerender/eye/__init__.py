"""The eye: its models, their catalogue with sources, pose and fixation."""
