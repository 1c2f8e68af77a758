# Included before anything is expanded: a setting that Make or the shell would read as more than names ends the run. Quotes cannot
# help, for Make itself takes lists apart at spaces and runs $(shell ...); plenocli, called without Make, takes any name.
SETTINGS := BANDS BATCH BUDGET CAMERA CAPTURES CFA CONFIG COUNT DARK DATA DOLL EXPERIMENTS FIT ITERATIONS LEARN LONG METHODS PHOTO PITCH \
	PLAN PYTHON REFINE RIGHT RUN RUNS SAMPLING SCENE SCENES SCHEDULER SEED SHORT SIGN SIZE SNR SUPERPIXELS SWEEPS TRADES TRAINING VENV \
	WHITE WORKERS
ONE_NAME := CAMERA CONFIG DATA DOLL PHOTO RUN RUNS SCENE SIGN VENV
# prerequisites of rules, where Make reads : and = as its own
NAMES := $(ONE_NAME) CAPTURES DARK SWEEPS TRADES WHITE

HASH := \#
BEYOND_NAMES := $$ & ; | < > ( ) { } [ ] " ' ` \ ! % $(HASH)
# what controls a terminal, which Make's own messages would pass on
CONTROLS := $(shell printf '\001 \002 \003 \004 \005 \006 \007 \010 \016 \017 \020 \021 \022 \023 \024 \025 \026 \027 \030 \031 \032 \033 \034 \035 \036 \037 \177'; \
	for a in 20 21 22 23; do for b in 0 1 2 3 4 5 6 7; do printf " \302\\$$a$$b"; done; done; \
	printf ' \342\200\252 \342\200\253 \342\200\254 \342\200\255 \342\200\256 \342\201\246 \342\201\247 \342\201\250 \342\201\251')
define NEWLINE


endef
found = $(strip $(foreach c,$(BEYOND_NAMES),$(findstring $c,$(value $1))) $(if $(findstring $(NEWLINE),$(value $1)),line break) \
	$(if $(strip $(foreach c,$(CONTROLS),$(findstring $c,$(value $1)))),a control character) \
	$(if $(filter $1,$(NAMES)),$(foreach c,: =,$(findstring $c,$(subst skimage:,,$(value $1))))) \
	$(if $(filter BANDS,$1),$(foreach b,$(value $1),$(if $(word 3,$(subst =, ,$b)),= twice))))

given := $(foreach v,$(SETTINGS),$(if $(filter command environment,$(firstword $(origin $v))),$v))
$(foreach v,$(given),$(if $(call found,$v),$(error $v holds $(call found,$v), which Make or the shell would read as more than a name; \
	rename the file, or call plenocli without make)))
$(foreach v,$(filter $(ONE_NAME),$(given)),$(if $(word 2,$(value $v)),$(error $v holds a space, where Make ends a name; \
	rename the file or folder, or call plenocli without make)))
$(foreach v,$(filter RUN RUNS VENV,$(given)),$(if $(strip $(value $v)),,$(error $v is empty, where a folder is due)))
