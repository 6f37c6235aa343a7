"""Files on disk: registration folders, records, atomic writes, hashes, mesh and NPZ files."""
