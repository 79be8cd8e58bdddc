"""A path on a site from here to there that a robot survives, or what stands in its way (SPEC section 14).

Elevation map, robot and motions -> costs of motions by the site kernel -> the cheapest path, each of its poses
simulated once more. It stands on `site`.
"""
