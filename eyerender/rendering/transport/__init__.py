"""Transport of light: lamps, shadow maps, irradiance grids, environment, radiosity, diffusion in tissue."""
