# Spectral calibration and demultiplexing, section 3-1 of the paper.
# make -f pipelines/spectral.mk RUN=runs/mine CONFIG=camera.toml BANDS="450nm 540nm 570nm 650nm"
# Every capture is a DNG, so that the same rules serve a real camera's files.
CONFIG ?= sample_configs/seed_spectral.toml
BANDS ?= 450nm 540nm 570nm 650nm
LONG ?= 10ms
SHORT ?= 2.5ms
METHODS ?= pinv wls lmmse nnls single-pixel
SUPERPIXELS ?= 3x3
PHOTO ?= skimage:astronaut

include $(dir $(lastword $(MAKEFILE_LIST)))spectral_captures.mk

# the response measured from narrow-band captures, and the one predicted from CONFIG
RESPONSES := measured predicted
# named one by one, so that make keeps them and makes them again when they are missing
spectra = $(foreach m,$(METHODS),$(RUN)/spectra/$(1)/$(2)-$m.h5)
SPECTRA := $(foreach r,$(RESPONSES),$(foreach e,$(EXPOSURES),$(call spectra,$r,chart-$e) $(call spectra,$r,white-$e))) $(foreach m,$(filter pinv single-pixel,$(METHODS)),$(RUN)/spectra/measured/photo-$m.h5)

all: $(RUN)/SHA256SUMS
$(RUN)/SHA256SUMS: $(RUN)/report.html
.PHONY: all

# large, and gone when the captures are made
.INTERMEDIATE: $(RUN)/pif.h5
.SECONDARY: $(RESPONSES:%=$(RUN)/spectra/%/) $(RAW)/

$(RAW)/chart-long.dng: $(RUN)/pif.h5 | $(RAW)/
	$(SIM) --target colorchecker --exposure $(LONG) --seed 4 -o $@
$(RAW)/chart-short.dng: $(RUN)/pif.h5 | $(RAW)/
	$(SIM) --target colorchecker --exposure $(SHORT) --seed 5 -o $@
# the paper's Fig. 8: a photograph at the short exposure
$(RAW)/photo.dng: $(RUN)/pif.h5 | $(RAW)/
	$(SIM) --scene $(PHOTO) --exposure $(SHORT) --seed 8 -o $@

$(RUN)/measured.h5: $(RAW)/white.dng $(RAW)/dark.dng $(BAND_FILES)
	$(P) calibrate --white $(RAW)/white.dng --dark $(RAW)/dark.dng $(foreach b,$(BANDS),--band $b=$(RAW)/band-$b.dng) -o $@ --overwrite
$(RUN)/predicted.h5: $(CONFIG) | $(RUN)
	$(P) simulate-response $< $(BANDS:%=--wavelength %) --exposure $(LONG) -o $@ --overwrite
$(RUN)/predicted-by-rays.h5: $(CONFIG) | $(RUN)
	$(P) simulate-response $< $(BANDS:%=--wavelength %) --exposure $(LONG) --model ray -o $@ --overwrite
$(RUN)/score-response.json: $(RUN)/predicted.h5 $(RUN)/predicted-by-rays.h5 $(RUN)/measured.h5
	$(P) score $(RUN)/predicted.h5 $(RUN)/predicted-by-rays.h5 --truth $(RUN)/measured.h5 -o $@ --overwrite

define DEMUX
$(RUN)/spectra/$(1)/%-$(2).h5: $(RAW)/%.dng $(RAW)/white.dng $(RUN)/$(1).h5 | $(RUN)/spectra/$(1)/
	$(P) demux $$< --calibration $(RUN)/$(1).h5 --method $(2) --reference $(RAW)/white.dng -o $$@ --overwrite
endef
$(foreach r,$(RESPONSES),$(foreach m,$(METHODS),$(eval $(call DEMUX,$r,$m))))

# all estimators in one table; the truth is what the filters let through of the chart, width, leak and all
define SCORE
$(RUN)/score-$(1)-%.json: $(call spectra,$(1),chart-%) $(call spectra,$(1),white-%) $(CONFIG)
	$(P) score $(call spectra,$(1),chart-$$*) --truth colorchecker --camera $(CONFIG) --patches colorchecker $(foreach m,$(METHODS),--white $(RUN)/spectra/$(1)/white-$$*-$m.h5) -o $$@ --overwrite
endef
$(foreach r,$(RESPONSES),$(eval $(call SCORE,$r)))

# the paper's figure of a spectral image opens in any OpenEXR viewer
$(RUN)/chart.exr: $(RAW)/chart-long.dng $(RUN)/measured.h5
	$(P) demux $< --calibration $(RUN)/measured.h5 --method pinv --reference $(RAW)/white.dng -o $@ --overwrite

SCORES := $(foreach r,$(RESPONSES),$(foreach e,$(EXPOSURES),$(RUN)/score-$r-$e.json)) $(RUN)/score-response.json
$(RUN)/report.html: $(SCORES) $(SPECTRA) $(RUN)/chart.exr
	$(P) report $(RUN) -o $@ --overwrite
