# The sweeps of sample_configs/sweeps, or your own: make -f pipelines/sweep.mk RUN=runs/mine SWEEPS="my.toml" WORKERS=4
# A sweep that was stopped goes on where it was; a changed file computes what is new.
SWEEPS ?= sample_configs/sweeps/lenslets.toml sample_configs/sweeps/filters.toml
RUN ?= runs/sweep
WORKERS ?= 1
SCHEDULER ?=

include $(dir $(lastword $(MAKEFILE_LIST)))common.mk

TABLES := $(patsubst %.toml,$(RUN)/%.h5,$(notdir $(SWEEPS)))

all: $(RUN)/SHA256SUMS
$(RUN)/SHA256SUMS: $(TABLES)
.PHONY: all

define RULE
$(RUN)/$(notdir $(basename $(1))).h5: $(1) | $(RUN)
	$(P) sweep $$< --workers $(WORKERS) $(SCHEDULER:%=--scheduler %) --plot $$(@:.h5=.png) -o $$@ --overwrite
endef
$(foreach s,$(SWEEPS),$(eval $(call RULE,$s)))
