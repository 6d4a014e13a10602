"""Pipelines around the public door: COLMAP databases, hloc files, folders of images; one process, many, or Ray.

A *source* (``colmap``, ``hloc``, ``folder``) names pairs and hands out their features; an engine (``engines``,
``ray_engine``) runs ``pair_worker`` on them; finished rows go to a ``journal``, from which the output is written in one
step at the end and a killed run goes on.
"""
