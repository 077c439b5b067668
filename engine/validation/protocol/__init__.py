"""The validation protocol of a marker-based lifting study: data set, folds, tables, figures.

Pure: what has to be read from videos, estimated or fitted is handed in by `engine.protocol`, which
knows the order of the steps.
"""
