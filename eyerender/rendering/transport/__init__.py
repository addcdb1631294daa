"""Light transport: lamps, shadow maps, irradiance grids, environment, radiosity, subsurface diffusion."""
