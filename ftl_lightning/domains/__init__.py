"""Domains: behaviour, concepts, sources of demonstrations and metrics of plans.

``domain`` is the interface, with ``tasks`` (evaluation), ``execution`` (closed loop), ``pictures`` and ``films``, ``recorder``
(demonstrations by hand) and ``comparison`` (published numbers, distances). ``registry`` finds the domains of installed packages by
name. ``from_file`` makes a domain of a file, without code. The smallest domain in code is the package ``examples/ftl-strokes``.
The folders here are the paper's domains.
"""
