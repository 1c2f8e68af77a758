# Spatial reconstruction, section 3-2 of the paper. make -f pipelines/spatial.mk RUN=runs/mine CONFIG=camera.toml SCENE=photo.png
#   same/  captures and inverts with the same matrix, as the paper does
#   finer/ captures with three times finer points, a 10 nm band and the neighbours' light, and inverts with the coarse matrices
CONFIG ?= sample_configs/seed_spatial.toml
SCENE ?= skimage:astronaut
SAMPLING ?= fit
SNR ?= 60dB
REFINE ?= 3
ITERATIONS ?= 20
BATCH ?= 6400
TRAINING ?=
METHODS ?= block-mean tikhonov tsvd nnls lmmse dictionary

include $(dir $(lastword $(MAKEFILE_LIST)))common.mk

SAME := $(METHODS:%=$(RUN)/same/%.h5) $(RUN)/same/lmmse-3x3.h5
FINER := $(METHODS:%=$(RUN)/finer/%.h5) $(RUN)/finer/lmmse-3x3.h5
EXTRA = $(if $(filter dictionary,$*),--dictionary $(RUN)/dictionary.h5)
TRAIN = $(if $(TRAINING),$(TRAINING:%=--training %))

all: $(RUN)/report.html
.PHONY: all

# the paper's matrix: one isolated lenslet
$(RUN)/pif.h5: $(CONFIG) | $(RUN)
	$(P) simulate-pif $< --superpixels 1x1 --coherent-ring 0 --accuracy 1e-5 -o $@ --overwrite

# the same lenslet among its neighbours, with the light that it sends to them
$(RUN)/pif-3x3.h5: $(CONFIG) | $(RUN)
	$(P) simulate-pif $< --superpixels 3x3 --coherent-ring 1 --accuracy 1e-4 -o $@ --overwrite

$(RUN)/same/capture.h5: $(CONFIG) $(RUN)/pif.h5 | $(RUN)/same/
	$(P) capture-sim $< --pif $(RUN)/pif.h5 --scene $(SCENE) --sampling $(SAMPLING) --snr $(SNR) --seed 1 -o $@ --overwrite

$(RUN)/finer/capture.h5: $(CONFIG) | $(RUN)/finer/
	$(P) capture-sim $< --refine $(REFINE) --bandwidth 10nm --superpixels 3x3 --coherent-ring 1 --scene $(SCENE) --sampling $(SAMPLING) --snr $(SNR) --seed 2 -o $@ --overwrite

$(RUN)/dictionary.h5: $(RUN)/pif.h5
	$(P) learn-dict $(TRAINING) --pif $< --batch $(BATCH) --iterations $(ITERATIONS) --snr $(SNR) --seed 3 -o $@ --overwrite

$(RUN)/same/dictionary.h5 $(RUN)/finer/dictionary.h5: $(RUN)/dictionary.h5

$(RUN)/same/%.h5: $(RUN)/same/capture.h5 $(RUN)/pif.h5
	$(P) reconstruct $< --pif $(RUN)/pif.h5 --method $* $(EXTRA) $(TRAIN) -o $@ --overwrite

$(RUN)/finer/%.h5: $(RUN)/finer/capture.h5 $(RUN)/pif.h5
	$(P) reconstruct $< --pif $(RUN)/pif.h5 --method $* $(EXTRA) $(TRAIN) -o $@ --overwrite

$(RUN)/same/lmmse-3x3.h5 $(RUN)/finer/lmmse-3x3.h5: $(RUN)/%/lmmse-3x3.h5: $(RUN)/%/capture.h5 $(RUN)/pif-3x3.h5 $(RUN)/pif.h5
	$(P) reconstruct $< --pif $(RUN)/$(if $(filter same,$*),pif,pif-3x3).h5 --method lmmse --overlap 3 $(TRAIN) -o $@ --overwrite

$(RUN)/score-same.json: $(SAME) $(RUN)/same/capture.h5
	$(P) score $(SAME) --truth $(RUN)/same/capture.h5 -o $@ --overwrite

$(RUN)/score-finer.json: $(FINER) $(RUN)/finer/capture.h5
	$(P) score $(FINER) --truth $(RUN)/finer/capture.h5 -o $@ --overwrite

$(RUN)/report.html: $(RUN)/score-same.json $(RUN)/score-finer.json
	$(P) report $(RUN) -o $@ --overwrite
