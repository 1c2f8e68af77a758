# Algorithm 1 of the paper at its full size: 40x40 points, 1600 atoms, 6400 patches an iteration.
#   make -f pipelines/dictionary.mk RUN=runs/mine ITERATIONS=100 TRAINING=photographs/
# Every iteration prints a line; stopped anywhere, the next make goes on after the last one. report.html draws the history. `ablation` learns once more without the incoherence term.
CONFIG ?= sample_configs/seed_spatial.toml
ITERATIONS ?= 20
SNR ?= 60dB
BATCH ?=
TRAINING ?=
LEARN ?=
SEED ?= 3

include $(dir $(lastword $(MAKEFILE_LIST)))common.mk

COMMON = $(TRAINING) --pif $(RUN)/pif.h5 $(BATCH:%=--batch %) --iterations $(ITERATIONS) --snr $(SNR) --seed $(SEED) --synthesis --checkpoint $(@D)/unfinished.h5 $(LEARN)

all: $(RUN)/SHA256SUMS
$(RUN)/SHA256SUMS: $(RUN)/report.html
ablation: $(RUN)/without-delta/report.html
.PHONY: all ablation

# one isolated lenslet, as in the paper
$(RUN)/pif.h5: $(CONFIG) | $(RUN)
	$(P) simulate-pif $< --model fresnel --superpixels 1x1 --coherent-ring 0 --accuracy 1e-5 -o $@ --overwrite

$(RUN)/dictionary.h5: $(RUN)/pif.h5
	$(P) learn-dict $(COMMON) -o $@ --overwrite

$(RUN)/without-delta/dictionary.h5: $(RUN)/pif.h5 | $(RUN)/without-delta/
	$(P) learn-dict $(COMMON) --delta 0 -o $@ --overwrite

$(RUN)/report.html $(RUN)/without-delta/report.html: %/report.html: %/dictionary.h5
	$(P) report $* -o $@ --overwrite
