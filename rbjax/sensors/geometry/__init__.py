"""Sensors with a geometry of their own: rays, cameras, volumes of sites.

- `rays.py`: intersections of a ray with primitive shapes.
- `rangefinder.py`: the distance along a ray to the nearest geom.
- `cameras.py`: the pixel at which a camera sees a frame.
- `volumes.py`: points and contacts in the volume of a site.
"""
