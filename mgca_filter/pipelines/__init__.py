"""Pipelines around the filter: COLMAP databases, hloc files, folders of images; one process, many, or Ray.

A *source* (``colmap``, ``hloc``, ``folder``) names pairs and hands out their features; ``run`` sends them through
workers (``worker``); finished rows go to a ``journal``, from which the output is written in one step at the end and a
killed run goes on. ``feature_cache`` keeps what was extracted from images, ``mapper_comparison`` shows what COLMAP's
mapper makes of the answers.
"""
