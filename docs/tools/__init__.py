"""What the documentation site makes at build time: references, figures and tables of measurements."""
