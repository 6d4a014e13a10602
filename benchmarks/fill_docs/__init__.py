"""Tables of the pages, made by commands: ``scoreboard``, ``trust`` and ``runtime`` fill what ``pages`` finds.

Each is run as ``python -m benchmarks.fill_docs.NAME``.
"""
