"""reconstruct: pictures from captures.

`run` takes every capture to `one_capture`, which makes its picture at once or `in_tiles`; what
captures share is a `recipe`, what is found of one is `solved`.
"""
