"""What jaxsand is measured against."""
