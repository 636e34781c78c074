"""What estimates: LMIs, certificates and observers."""
