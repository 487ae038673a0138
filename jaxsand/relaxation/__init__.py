"""Sand flows to its angle of repose: fluxes, schemes, stop rules, settling."""
