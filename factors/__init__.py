"""GTSAM factors for dense flow between moving cameras; imports numpy and gtsam only.

The numpy-only modules (``projection``, ``robust``, ``compression``, ``keys``, ``flow_terms``) can be
imported without loading gtsam, so this file imports nothing.
"""
