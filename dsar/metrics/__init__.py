"""Measures of images that training and evaluation share."""
