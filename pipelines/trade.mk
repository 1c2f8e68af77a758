# What accuracy buys in decibels, spectra and depth, and what it costs: sweeps whose capture is simulated once, finer than it is inverted,
# and inverted in many ways. Tables, their measured seconds and a page with plots in RUN. Your own: make -f pipelines/trade.mk TRADES=my.toml
TRADES ?= $(foreach s,trade trade_iterations trade_spectral trade_depth,sample_configs/sweeps/$s.toml)
RUN ?= runs/trade
SWEEPS = $(TRADES)

include $(dir $(lastword $(MAKEFILE_LIST)))sweep.mk
.DEFAULT_GOAL := page

# sealed once, with the page
page: $(TABLES)
	$(P) report $(RUN) --title "What accuracy buys, and what it costs" -o $(RUN)/trade.html --overwrite
	@$(SEAL)
.PHONY: page
