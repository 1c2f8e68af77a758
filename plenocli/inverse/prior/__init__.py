"""What natural images look like to one camera: patches, covariances, estimators that rest on them.

No pictures are read here: whoever asks hands them in.
"""
