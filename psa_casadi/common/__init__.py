"""What every room uses: errors, units, files, child processes, progress."""
