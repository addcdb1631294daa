"""The eye tracker's hardware: cameras, lights, screen, sensor."""
