// Notes are screened before they are kept, by the rules of app/planning/visit_day/screening.py, which come with the page.
const WORD = /\p{L}+(?:['’-]\p{L}+)*/gu;

export function screen(text, rules, noNames = []) {
  const found = [];
  let rest = text;
  for (const [kind, patterns] of Object.entries(rules.patterns)) {
    for (const pattern of patterns) {
      const expression = new RegExp(pattern, "gi");
      for (const match of rest.matchAll(expression)) found.push({ kind, text: match[0].trim() });
      rest = rest.replace(expression, " ");
    }
  }
  const cleared = new Set([...rules.plain_words, ...noNames.map((word) => word.toLowerCase())]);
  for (const [word] of rest.matchAll(WORD)) {
    const acronym = word === word.toUpperCase() && [...word].length <= 6;
    const first = [...word][0];
    if (first !== first.toLowerCase() && !acronym && !cleared.has(word.toLowerCase())) found.push({ kind: "name", text: word });
  }
  return found.filter((one, i) => found.findIndex((other) => other.kind === one.kind && other.text === one.text) === i);
}
