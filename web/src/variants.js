// Chooses options of variants: which parts are visible, and how their colours are mapped.

export class Variants {
  /** Takes the parts and variants of the page, and what to call with each part's state when it changes. */
  constructor({ parts, variants }, apply) {
    Object.assign(this, { parts, variants, apply });
    this.chosen = Object.fromEntries(variants.map(({ name, options }) => [name, options[0].name]));
  }

  /** Chooses an option of a variant. */
  choose(variant, option) {
    const found = this.variants.find(({ name }) => name === variant);
    if (!found?.options.some(({ name }) => name === option)) throw new Error(`no option ${option} of ${variant}`);
    this.chosen[variant] = option;
    this.update();
  }

  /** Returns whether a part, by its index, is visible. */
  shows(part) {
    const hidden = this.variants.some(({ name, options }) => {
      const own = options.filter(({ shows }) => shows.includes(part));
      return own.length > 0 && !own.some((option) => option.name === this.chosen[name]);
    });
    return this.parts[part].visible && !hidden;
  }

  /** Applies what is chosen to all parts. */
  update() {
    const current = this.variants.map(({ name, options }) => options.find((option) => option.name === this.chosen[name]));
    this.parts.forEach((part, i) => {
      const color = current.map(({ colors }) => colors[i]).find(Boolean) ?? part.color;
      this.apply(i, this.shows(i), color);
    });
  }
}
