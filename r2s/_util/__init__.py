"""Files, units, threads and optional libraries: what every package uses."""
