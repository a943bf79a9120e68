"""What is said, as one tree of plain data: which words, rows and figures, in which order. Renderers are in ``show``."""
