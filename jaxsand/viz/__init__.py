"""Figures and animations, by matplotlib and Pillow."""
