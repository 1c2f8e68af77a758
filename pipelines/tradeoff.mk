# What the accuracy dial promises and delivers: table, figures and plot. Measurements and brute-force columns are kept in RUN, so
# that a rerun computes only what changed. PLAN=1 says what would be run and for how long.
RUN ?= runs/tradeoff
include $(dir $(lastword $(MAKEFILE_LIST)))common.mk
HERE := $(dir $(lastword $(MAKEFILE_LIST)))
BUDGET ?= 30

all: $(RUN)/tradeoff.md
.PHONY: all FORCE

$(RUN)/tradeoff.md: FORCE
	python $(HERE)benchmarks/tradeoff.py --run $(RUN) --budget $(BUDGET) $(if $(PLAN),--plan)
