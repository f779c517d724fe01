# Values of R that the tests of ml/statistics are held against: Rscript r-reference.R > r-reference.json
# Needs coin, lmerTest, metafor, jsonlite; the versions are written into the file.
suppressPackageStartupMessages({library(coin); library(lmerTest); library(metafor); library(jsonlite)})

ranksum <- function(name, x, y) {
  d <- data.frame(v = c(x, y), g = factor(rep(c("x", "y"), c(length(x), length(y))), levels = c("x", "y")))
  p <- function(side) as.numeric(pvalue(wilcox_test(v ~ g, data = d, distribution = "exact", alternative = side)))
  shift <- if (length(x) * length(y) < 100) confint(wilcox_test(v ~ g, data = d, distribution = "exact", conf.int = TRUE)) else NULL
  list(name = name, x = I(x), y = I(y), two_sided = p("two.sided"), greater = p("greater"), less = p("less"),
       shift = as.numeric(shift$estimate), low = shift$conf.int[1], high = shift$conf.int[2])
}

shuffled <- function(name, value, visit, tested) {
  # whole scores (twice the ranks), shuffled within visits: ranks of each visit (van Elteren's test where visits are of one size), and ranks
  # over all visits of the values less their visit's mean (aligned ranks)
  exact <- function(score) {
    d <- data.frame(score = score, g = factor(ifelse(tested == 1, "a", "b"), levels = c("a", "b")), b = factor(visit))
    p <- function(side) as.numeric(pvalue(independence_test(score ~ g | b, data = d, alternative = side, distribution = "exact")))
    list(greater = p("greater"), less = p("less"))
  }
  within <- if (length(unique(table(visit))) == 1) exact(2 * ave(value, visit, FUN = rank)) else NULL
  aligned <- exact(2 * rank(round(value - ave(value, visit), 9)))
  list(name = name, value = value, visit = visit, tested = tested, van_elteren = within, aligned = aligned)
}

mixed <- function(name, value, visit, tested, policy) {
  d <- data.frame(y = value, x = tested - 0.5, t = tested, visit = factor(visit), policy = factor(policy))
  f <- if (length(unique(policy[tested == 1])) > 1) y ~ x + (1 | visit) + (0 + x | visit) + (0 + t | policy) else y ~ x + (1 | visit) + (0 + x | visit)
  m <- lmer(f, data = d, REML = TRUE, control = lmerControl(optimizer = "bobyqa", optCtrl = list(rhoend = 1e-10), check.conv.singular = "ignore"))
  s <- coef(summary(m))["x", ]
  v <- as.data.frame(VarCorr(m))
  sd <- function(var, grp) { k <- v$sdcor[!is.na(v$var1) & v$var1 == var & startsWith(v$grp, grp)]; if (length(k)) k[[1]] else NULL }
  list(name = name, value = value, visit = visit, tested = tested, policy = policy, estimate = s[["Estimate"]], error = s[["Std. Error"]],
       satterthwaite = s[["df"]], p = s[["Pr(>|t|)"]], visit_sd = sd("(Intercept)", "visit"), slope_sd = sd("x", "visit"),
       policy_sd = sd("t", "policy"), session_sd = sigma(m))
}

pooled <- function(name, y, se) {
  m <- rma(yi = y, sei = se, method = "PM", test = "knha", control = list(tol = 1e-14, maxiter = 10000))
  a <- rma(yi = y, sei = se, method = "PM", test = "adhoc", control = list(tol = 1e-14, maxiter = 10000))
  list(name = name, y = y, se = se, tau2 = m$tau2, estimate = as.numeric(m$b), low = a$ci.lb, high = a$ci.ub, p = a$pval)
}

set.seed(20261123)
tables <- list(
  ranksum("no ties, 8 against 8 (Bauer 1972)", c(6, 20, 27, 38, 46, 51, 54, 57), c(10, 12, 15, 21, 32, 40, 41, 45)),
  ranksum("no ties, 5 against 10 (Hollander and Wolfe 1999)", c(0.88, 0.90, 0.74, 1.21, 1.15), c(0.80, 0.83, 1.89, 1.04, 1.45, 1.38, 1.91, 1.64, 0.73, 1.46)),
  ranksum("ceiling, 12 against 12 (Bergmann, Ludbrook and Spooren 2000)", rep(300, 12), c(1, 2, 3, 4, 5, rep(300, 7))),
  ranksum("tied, 14 against 11 (Brunner and Munzel 2000)", c(1, 2, 1, 1, 1, 1, 1, 1, 1, 1, 2, 4, 1, 1), c(3, 3, 4, 3, 1, 2, 3, 1, 1, 5, 4)))
for (sizes in list(c(1, 5), c(3, 4), c(4, 4), c(6, 9), c(12, 7), c(20, 15), c(30, 24)))
  tables[[length(tables) + 1]] <- ranksum(sprintf("ratings, %d against %d", sizes[1], sizes[2]),
    pmin(pmax(round(rnorm(sizes[1], 7.4, 1)), 1), 10), pmin(pmax(round(rnorm(sizes[2], 6.8, 1)), 1), 10))
for (sizes in list(c(2, 2), c(5, 6), c(9, 14)))
  tables[[length(tables) + 1]] <- ranksum(sprintf("no ties, %d against %d", sizes[1], sizes[2]), round(rnorm(sizes[1]), 4), round(rnorm(sizes[2], 0.6), 4))

strata <- list()
for (k in 1:6) {
  n <- if (k <= 4) rep(c(6, 7, 4, 8)[k], 4) else c(6, 5, 8, 4)
  visit <- rep(1:4, n); tested <- unlist(lapply(n, function(m) sample(rep(c(1, 0), length.out = m))))
  noise <- rnorm(length(visit)) + 0.7 * tested
  value <- if (k %% 2) round(noise + visit, 3) else pmin(pmax(round(7 + noise), 1), 10)
  strata[[k]] <- shuffled(sprintf("%s, visits of %s", if (k %% 2) "no ties" else "ratings", paste(n, collapse = ", ")), value, visit, tested)
}

models <- list()
for (k in 1:5) {
  n <- if (k == 2) c(3, 7, 5, 6, 4) else rep(6, c(6, 5, 8, 6, 10)[k])
  visit <- rep(seq_along(n), n); tested <- unlist(lapply(n, function(m) rep(c(0, 1), length.out = m)))
  slope <- 0.5 + c(0.4, 0.6, 0, 0.5, 1.2)[k] * rnorm(length(n))
  policy <- if (k == 4) ifelse(tested == 1, sample(1:3, length(visit), TRUE), 0) else tested
  value <- round(2 + rnorm(length(n))[visit] + slope[visit] * tested + 0.4 * rnorm(length(visit)) + if (k == 4) c(0, -0.5, 0, 0.5)[policy + 1] else 0, 4)
  models[[k]] <- mixed(sprintf("%d visits, case %d", length(n), k), value, visit, tested, policy)
}

p <- list(c(0.01, 0.02, 0.022, 0.09), c(0.03, 0.04, 0.9), c(0.001, 0.2, 0.03, 0.03, 0.5, 0.04), round(runif(10, 0, 0.2), 4))
adjusted <- lapply(p, function(v) list(p = v, holm = p.adjust(v, "holm"), hommel = p.adjust(v, "hommel"), BH = p.adjust(v, "BH")))

pools <- list(
  pooled("four that differ", c(0.1, 0.9, 0.4, 1.4), c(0.1, 0.3, 0.2, 0.4)),
  pooled("four that agree", c(0.30, 0.31, 0.29, 0.33), c(0.1, 0.3, 0.2, 0.4)),
  pooled("six", c(-12, 5, 20, 31, 8, 14), c(4, 6, 9, 5, 7, 3)))

versions <- c(list(R = paste(R.version$major, R.version$minor, sep = ".")),
  lapply(setNames(nm = c("coin", "lme4", "lmerTest", "metafor")), function(p) as.character(packageVersion(p))))
cat(toJSON(list(versions = versions, ranksum = tables, stratified = strata, mixed = models, adjusted = adjusted, pooled = pools),
  auto_unbox = TRUE, digits = NA, null = "null"))
