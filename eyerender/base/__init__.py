"""What every package uses: errors, array values, specs, storage, progress, processes, compilation, versions."""
