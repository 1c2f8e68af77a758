# Captures of cameras that are not quite the one that was described, inverted by every method: with the matrix of the camera as
# described (nominal), and with the matrix that made the capture (right). make -f pipelines/mismatch.mk RUN=runs/mine SIZE=full
#   SIZE=half    half as many points and pixels a side, lenslets half as wide; full is CONFIG as it stands
#   COUNT        lenslets a side, at most
#   METHODS      by the nominal matrix; RIGHT: by the right one; FIT: by that of the camera fitted to each capture
# What each row disturbs stands in mismatch.py. Lenslets are isolated, as in the paper's experiment.
CONFIG ?= sample_configs/seed_spatial.toml
SIZE ?= half
COUNT ?= 6
SCENES ?= skimage:astronaut skimage:coffee
SNR ?= 60dB
ITERATIONS ?= 3
BATCH ?= 1600
TRAINING ?=
METHODS ?= block-mean tikhonov tsvd nnls-300 lmmse dictionary tv pnp auto
RIGHT ?= lmmse auto
FIT ?=

include $(dir $(lastword $(MAKEFILE_LIST)))common.mk
HERE := $(dir $(lastword $(filter %mismatch.mk,$(MAKEFILE_LIST))))
D := python $(HERE)mismatch.py

# rows with a camera of their own, those that change the capture of the camera as described, and the one at f/4.4
OWN := exact focus pitch wavelength shift lenslet-focus sensor-distance
CHANGED := veil-1 veil-5 dead hot clipped dim-100 dim-1000
FAST := exact-fast
NAMES := $(foreach scene,$(SCENES),$(basename $(lastword $(subst :, ,$(subst /, ,$(scene))))))
named = $(foreach row,$(1),$(NAMES:%=%--$(row)))
CAPTURES := $(patsubst %,$(RUN)/captures/%.h5,$(call named,none $(OWN) $(CHANGED)))
FAST_CAPTURES := $(patsubst %,$(RUN)/captures/%.h5,$(call named,$(FAST)))
PIFS := $(patsubst %,$(RUN)/pifs/%.h5,nominal nominal-fast $(OWN) $(FAST))

MODEL_exact := exact --accuracy 1e-4
MODEL_exact-fast := exact --accuracy 1e-4
MODEL = $(or $(MODEL_$*),fresnel --accuracy 1e-5)
OPTIONS_nnls-300 := --method nnls --nnls-iterations 300
OPTIONS = $(or $(OPTIONS_$(1)),--method $(1)) $(if $(filter lmmse tv pnp auto,$(1)),$(TRAINING:%=--training %))
DICTIONARY = $(if $(filter dictionary,$(1)),--dictionary $(RUN)/dictionaries/$(2).h5)

all: $(RUN)/SHA256SUMS
$(RUN)/SHA256SUMS: $(RUN)/report.html
.PHONY: all
.SECONDARY:

$(RUN)/cameras/%.toml: $(CONFIG) $(HERE)mismatch.py | $(RUN)/cameras/
	$(D) camera $* $< --size $(SIZE) --count $(COUNT) -o $@

$(RUN)/pifs/%.h5: $(RUN)/cameras/%.toml | $(RUN)/pifs/
	$(P) simulate-pif $< --model $(MODEL) --superpixels 1x1 --coherent-ring 0 -o $@ --overwrite

# a sensor that is a tenth of a pixel off: pixels of a third, put together again
$(RUN)/pifs/shift.h5: $(RUN)/pifs/finer.h5 $(RUN)/pifs/nominal.h5
	$(D) shift $^ -o $@

# what a capture of each camera is called; $(1): row, $(2): camera, $(3): scene
define captured
$(RUN)/captures/$(basename $(lastword $(subst :, ,$(subst /, ,$(3)))))--$(1).h5: $(RUN)/cameras/$(2).toml $(RUN)/pifs/$(or $(4),$(1)).h5 | $(RUN)/captures/
	$(P) capture-sim $$< --pif $$(word 2,$$^) --scene $(3) --snr $(SNR) --seed 1 -o $$@ --overwrite
endef
$(foreach scene,$(SCENES),$(eval $(call captured,none,nominal,$(scene),nominal)))
$(foreach scene,$(SCENES),$(eval $(call captured,shift,nominal,$(scene))))
$(foreach row,$(filter-out shift,$(OWN)) $(FAST),$(foreach scene,$(SCENES),$(eval $(call captured,$(row),$(row),$(scene)))))

define changed
$(RUN)/captures/%--$(1).h5: $(RUN)/captures/%--none.h5 $(HERE)mismatch.py
	$(D) capture $(1) $$< -o $$@
endef
$(foreach row,$(CHANGED),$(eval $(call changed,$(row))))

$(RUN)/dictionaries/%.h5: $(RUN)/pifs/%.h5 | $(RUN)/dictionaries/
	$(P) learn-dict $(TRAINING) --pif $< --batch $(BATCH) --iterations $(ITERATIONS) --snr $(SNR) --seed 3 --synthesis -o $@ --overwrite

# all captures of a method in one run, which sets it up once; a file says that they are done. $(1): folder, $(2): method
define by_nominal
$(RUN)/$(1)/$(2)/.done: $(CAPTURES) $(FAST_CAPTURES) $(PIFS) $(if $(filter dictionary,$(2)),$(RUN)/dictionaries/nominal.h5 $(RUN)/dictionaries/nominal-fast.h5) | $(RUN)/$(1)/$(2)/
	$(P) reconstruct $(CAPTURES) --pif $(RUN)/pifs/nominal.h5 $(call OPTIONS,$(2)) $(call DICTIONARY,$(2),nominal) -o $(RUN)/$(1)/$(2) --overwrite
	$(foreach capture,$(FAST_CAPTURES),$(P) reconstruct $(capture) --pif $(RUN)/pifs/nominal-fast.h5 $(call OPTIONS,$(2)) $(call DICTIONARY,$(2),nominal-fast) -o $(RUN)/$(1)/$(2)/$(notdir $(capture)) --overwrite &&) touch $$@
endef
$(foreach method,$(METHODS),$(eval $(call by_nominal,nominal,$(method))))

# the camera as described made true by the capture itself, and its matrix
$(RUN)/fitted/%.toml: $(RUN)/captures/%.h5 | $(RUN)/cameras/nominal.toml $(RUN)/cameras/nominal-fast.toml $(RUN)/fitted/
	$(P) fit-camera $< --camera $(RUN)/cameras/nominal$(if $(filter %-fast,$*),-fast).toml -o $@ --overwrite

$(RUN)/fitted/%.h5: $(RUN)/fitted/%.toml
	$(P) simulate-pif $< --model $(or $(MODEL_$(lastword $(subst --, ,$*))),fresnel --accuracy 1e-5) --superpixels 1x1 --coherent-ring 0 -o $@ --overwrite

FITTED := $(call named,none $(OWN) $(FAST) veil-1 dead)
define by_fit
$(RUN)/fit/$(1)/.done: $(FITTED:%=$(RUN)/fitted/%.h5) | $(RUN)/fit/$(1)/
	$(foreach name,$(FITTED),$(P) reconstruct $(RUN)/captures/$(name).h5 --pif $(RUN)/fitted/$(name).h5 $(call OPTIONS,$(1)) -o $(RUN)/fit/$(1)/$(name).h5 --overwrite &&) touch $$@
endef
$(foreach method,$(FIT),$(eval $(call by_fit,$(method))))

define by_right
$(RUN)/right/$(1)/.done: $(CAPTURES) $(FAST_CAPTURES) $(PIFS) | $(RUN)/right/$(1)/
	$(foreach row,$(OWN) $(FAST),$(foreach name,$(NAMES),$(P) reconstruct $(RUN)/captures/$(name)--$(row).h5 --pif $(RUN)/pifs/$(row).h5 $(call OPTIONS,$(1)) -o $(RUN)/right/$(1)/$(name)--$(row).h5 --overwrite &&)) touch $$@
endef
$(foreach method,$(RIGHT),$(eval $(call by_right,$(method))))

DONE := $(METHODS:%=$(RUN)/nominal/%/.done) $(RIGHT:%=$(RUN)/right/%/.done) $(FIT:%=$(RUN)/fit/%/.done)
SCORES := $(patsubst $(RUN)/captures/%.h5,$(RUN)/scores/%.json,$(CAPTURES) $(FAST_CAPTURES))

# the results of a capture are called by the folders that they lie in
$(RUN)/scores/%.json: $(DONE) | $(RUN)/scores/
	$(P) score $$(ls $(DONE:%.done=%$*.h5) 2> /dev/null) --truth $(RUN)/captures/$*.h5 -o $@ --overwrite > /dev/null

$(RUN)/report.html: $(SCORES) $(HERE)mismatch.py
	$(D) report $(RUN) -o $@
