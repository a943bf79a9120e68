"""Other libraries' filters behind the four methods of :class:`consistency.protocols.Filter`."""
