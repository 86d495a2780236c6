"""The nodes.

Throughout, ``node`` is one in the namespace of the topics, ``settings`` are validated, and
``source`` is what their config is called in errors.
"""
