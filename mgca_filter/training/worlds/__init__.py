"""Rendered worlds: photographs on the faces of random 3-D scenes, seen by cameras that are known exactly.

``world`` draws faces, ``cameras`` draws views of them, ``visibility`` says which face a pixel shows, ``rendering``
paints it, ``imaging`` makes a photograph of the painting, ``truth`` labels matches, ``views`` ties them together.
"""
