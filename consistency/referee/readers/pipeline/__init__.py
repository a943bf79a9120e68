"""From files to records: the kind of a file, its reader, and the one way from poses to a record."""
