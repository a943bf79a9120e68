"""What commands ask of the operating system: whole files, signals, processes, the origin of results."""
