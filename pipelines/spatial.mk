# Spatial reconstruction, section 3-2 of the paper. make -f pipelines/spatial.mk RUN=runs/mine CONFIG=camera.toml SCENE=photo.png
#   paper/  captured and inverted with the same matrix of isolated lenslets, as the paper does
#   stray/  captured with three times finer points, a 10 nm band (five wavelengths), the neighbours' light and lenslets PITCH times
#           as large, pixels too; inverted with the coarse matrix of the camera as described, the neighbours' light taken away (and
#           once without, to show what that costs). The score has beside each method what this is expected to cost
#   model/  captured with the exact model, inverted with the paraxial matrix of paper/; as lmmse-right with the exact one
CONFIG ?= sample_configs/seed_spatial.toml
SCENE ?= skimage:astronaut
SAMPLING ?= fit
SNR ?= 60dB
REFINE ?= 3
PITCH ?= 1.001
ITERATIONS ?= 10
BATCH ?=
TRAINING ?=
EXPERIMENTS ?= paper stray model

include $(dir $(lastword $(MAKEFILE_LIST)))common.mk

# a result is called by its method; what a method needs beyond its name stands here
METHODS := block-mean tikhonov tsvd nnls-300 nnls lmmse dictionary tv pnp
OPTIONS_lmmse-3x3 := --method lmmse --overlap 3
OPTIONS_dictionary := --method dictionary --dictionary $(RUN)/dictionary.h5
OPTIONS_unlearned := --method dictionary --dictionary $(RUN)/unlearned.h5
STEPS = $(patsubst nnls-%,%,$(filter nnls-%,$*))
OPTIONS_lmmse-no-neighbours := --method lmmse --pif $(RUN)/pif.h5
OPTIONS_lmmse-right := --method lmmse --pif $(RUN)/pif-exact.h5
OPTIONS = $(or $(OPTIONS_$*),$(STEPS:%=--method nnls --nnls-iterations %),--method $*) $(if $(filter lmmse% tv pnp auto,$*),$(TRAINING:%=--training %))

PAPER := $(patsubst %,$(RUN)/paper/%.h5,$(METHODS) lmmse-3x3)
# converged nnls takes minutes a sweep and only shows again what it does on the paper's capture
STRAY := $(patsubst %,$(RUN)/stray/%.h5,$(filter-out nnls,$(METHODS)) lmmse-no-neighbours)
MODEL := $(patsubst %,$(RUN)/model/%.h5,$(filter-out nnls,$(METHODS)) auto lmmse-right)

all: $(RUN)/SHA256SUMS
$(RUN)/SHA256SUMS: $(RUN)/report.html
.PHONY: all

# the paper's matrix: one isolated lenslet
$(RUN)/pif.h5: $(CONFIG) | $(RUN)
	$(P) simulate-pif $< --model fresnel --superpixels 1x1 --coherent-ring 0 --accuracy 1e-5 -o $@ --overwrite

# the same without the paraxial approximation
$(RUN)/pif-exact.h5: $(CONFIG) | $(RUN)
	$(P) simulate-pif $< --model exact --superpixels 1x1 --coherent-ring 0 --accuracy 1e-4 -o $@ --overwrite

# the same lenslet among its neighbours, with the light that it sends to them
$(RUN)/pif-3x3.h5: $(CONFIG) | $(RUN)
	$(P) simulate-pif $< --model fresnel --superpixels 3x3 --coherent-ring 1 --accuracy 1e-3 -o $@ --overwrite

$(RUN)/paper/capture.h5: $(CONFIG) $(RUN)/pif.h5 | $(RUN)/paper/
	$(P) capture-sim $< --pif $(RUN)/pif.h5 --scene $(SCENE) --sampling $(SAMPLING) --snr $(SNR) --seed 1 -o $@ --overwrite

# superpixels must stay whole numbers of pixels: the pixels grow with the lenslets
$(RUN)/stray/camera.toml: $(CONFIG) | $(RUN)/stray/
	awk -v k=$(PITCH) '/^(superpixel_pitch|pixel_pitch|pitch) *=/ { match($$0, /[0-9.]+/); printf "%s%.9g%s\n", substr($$0, 1, RSTART - 1), substr($$0, RSTART, RLENGTH) * k, substr($$0, RSTART + RLENGTH); next } { print }' $< > $@

$(RUN)/stray/capture.h5: $(RUN)/stray/camera.toml
	$(P) capture-sim $< --model fresnel --accuracy 1e-3 --refine $(REFINE) --bandwidth 10nm --superpixels 3x3 --coherent-ring 1 --scene $(SCENE) --sampling $(SAMPLING) --snr $(SNR) --seed 2 -o $@ --overwrite

$(RUN)/model/capture.h5: $(CONFIG) $(RUN)/pif-exact.h5 | $(RUN)/model/
	$(P) capture-sim $(CONFIG) --pif $(RUN)/pif-exact.h5 --scene $(SCENE) --sampling $(SAMPLING) --snr $(SNR) --seed 1 -o $@ --overwrite

$(RUN)/dictionary.h5: $(RUN)/pif.h5
	$(P) learn-dict $(TRAINING) --pif $< $(BATCH:%=--batch %) --iterations $(ITERATIONS) --snr $(SNR) --seed 3 --synthesis -o $@ --overwrite

# the start of Algorithm 1, to tell what learning adds
$(RUN)/unlearned.h5: $(RUN)/pif.h5
	$(P) learn-dict $(TRAINING) --pif $< --iterations 0 --snr $(SNR) --seed 3 --synthesis -o $@ --overwrite

$(RUN)/paper/unlearned.h5: $(RUN)/unlearned.h5

$(RUN)/paper/dictionary.h5 $(RUN)/stray/dictionary.h5 $(RUN)/model/dictionary.h5: $(RUN)/dictionary.h5

$(RUN)/paper/%.h5: $(RUN)/paper/capture.h5 $(RUN)/pif.h5
	$(P) reconstruct $< --pif $(RUN)/pif.h5 $(OPTIONS) -o $@ --overwrite

$(RUN)/stray/lmmse-no-neighbours.h5: $(RUN)/stray/%.h5: $(RUN)/stray/capture.h5 $(RUN)/pif.h5
	$(P) reconstruct $< $(OPTIONS) -o $@ --overwrite

$(RUN)/stray/%.h5: $(RUN)/stray/capture.h5 $(RUN)/pif-3x3.h5
	$(P) reconstruct $< --pif $(RUN)/pif-3x3.h5 --overlap 3 $(OPTIONS) -o $@ --overwrite

$(RUN)/model/lmmse-right.h5: $(RUN)/model/%.h5: $(RUN)/model/capture.h5 $(RUN)/pif-exact.h5
	$(P) reconstruct $< $(OPTIONS) -o $@ --overwrite

$(RUN)/model/%.h5: $(RUN)/model/capture.h5 $(RUN)/pif.h5
	$(P) reconstruct $< --pif $(RUN)/pif.h5 $(OPTIONS) -o $@ --overwrite

$(RUN)/score-paper.json: $(PAPER) $(RUN)/paper/capture.h5
	$(P) score $(PAPER) --truth $(RUN)/paper/capture.h5 -o $@ --overwrite

$(RUN)/score-stray.json: $(STRAY) $(RUN)/stray/capture.h5
	$(P) score $(STRAY) --truth $(RUN)/stray/capture.h5 -o $@ --overwrite

$(RUN)/score-model.json: $(MODEL) $(RUN)/model/capture.h5
	$(P) score $(MODEL) --truth $(RUN)/model/capture.h5 -o $@ --overwrite

$(RUN)/report.html: $(EXPERIMENTS:%=$(RUN)/score-%.json)
	$(P) report $(RUN) -o $@ --overwrite
