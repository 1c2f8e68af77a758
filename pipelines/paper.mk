# Every figure of the paper, with what it says and what comes out: RUN/paper.html.
# make -f pipelines/paper.mk RUN=runs/mine DOLL=doll.png TRAINING=frames/
#   DOLL: the paper's picture (Dolls of Middlebury, 2005), the astronaut without it
#   TRAINING: frames of motion pictures as the paper has them, else photographs of scikit-image; patches come from
#     anywhere in them, mirrored and at three scales
RUN ?= runs/paper
DOLL ?=
TRAINING ?=
include $(dir $(lastword $(MAKEFILE_LIST)))common.mk
HERE := $(dir $(lastword $(MAKEFILE_LIST)))
SUB = +$(MAKE) --no-print-directory -f
CAMERA := sample_configs/seed_spatial.toml
SPATIAL := $(RUN)/$(if $(DOLL),doll,astronaut)

all: spatial spectral $(RUN)/learning.csv
	python $(HERE)paper.py $(SPATIAL) $(RUN)/spectral $(RUN)/learning.csv $(RUN)/paper.html
	@$(SEAL)
.PHONY: all spatial spectral

# what learning gains on five photographs, iteration by iteration; it needs the matrix alone
$(RUN)/learning.csv: $(SPATIAL)/pif.h5 $(HERE)learning.py
	python $(HERE)learning.py $< $@

$(SPATIAL)/pif.h5: $(CAMERA)
	$(SUB) $(HERE)spatial.mk RUN=$(SPATIAL) CONFIG=$(CAMERA) $@

# non-negative least squares at several steps: the paper does not say where it stopped
spatial: $(SPATIAL)/pif.h5
	$(SUB) $(HERE)spatial.mk RUN=$(SPATIAL) CONFIG=$(CAMERA) $(DOLL:%=SCENE=%) TRAINING="$(TRAINING)" EXPERIMENTS=paper \
	  METHODS="block-mean tikhonov nnls-100 nnls-300 nnls-1000 nnls-3000 lmmse unlearned dictionary pnp"

spectral:
	$(SUB) $(HERE)spectral.mk RUN=$(RUN)/spectral CONFIG=sample_configs/paper_spectral.toml METHODS="pinv single-pixel" SHORT=0.3ms SUPERPIXELS=auto
